"""The rows of tables of drift, beside which the truth's own error stands."""

from __future__ import annotations

from typing import Any

Found = dict[str, Any]
Rows = dict[str, dict[str, Any]]
TRUTH = "truth's ratio"
PEERS = ("ORB-SLAM3", "COLMAP")  # of the first there are poses of all rows
OF_TRUTH = ", truth"  # how the commands end that print it
SHOWN = ("10", "50", "t_rel")  # lengths of segments; the command prints more


def drift(found: Found) -> Rows:
    """Both odometries on both drives; of kiss-icp the median over ranges."""
    rows: Rows = {}
    for drive in [name.removesuffix(" visual") for name in found if name.endswith(" visual")]:
        one, many = found[f"{drive} visual"], found[f"{drive} kiss"]["spread"]
        path, ratio = one["trajectory"], truths_ratio(found[f"{drive}{OF_TRUTH}"])
        rows[f"{drive}, `visual`"] = {
            "t_rel": path["t_rel_percent"],
            TRUTH: ratio,
            "r_rel": path["r_rel_deg_per_100m"],
            "ATE": 100 * path["ate_m"],
            "not trusted": one["frames_not_trusted"],
        }
        t_rel = many["t_rel_percent"]
        rows[f"{drive}, `kiss`"] = {
            "t_rel": t_rel["median"],
            TRUTH: ratio,
            "least to most": f"{t_rel['least']:.2f} to {t_rel['most']:.2f} %",
            "r_rel": many["r_rel_deg_per_100m"]["median"],
            "ATE": 100 * many["ate_m"]["median"],
            "not trusted": round(many["untrusted"]["median"]),
        }
    return rows


def lenses(found: Found) -> Rows:
    """Drift, and F of the map beside the drive that it was measured for."""
    rows: Rows = {}
    for label, one in found.items():
        if label.endswith(OF_TRUTH):
            rows[label.removesuffix(OF_TRUTH)][TRUTH] = truths_ratio(one)
            continue
        path = one.get("trajectory")
        if path is None:
            rows[label.removesuffix(", F")]["F, own path"] = one["f_score"]
            continue
        rows[label] = {
            "t_rel": path["t_rel_percent"],
            "r_rel": path["r_rel_deg_per_100m"],
            "ATE": 100 * path["ate_m"],
            "length": one["path_length_m"] / path["path_length_m"],
        }
    return rows


def altered(found: Found) -> Rows:
    """Both rigs side by side; the peer, which refines none, once."""
    rows: Rows = {}
    for label, cases in found.items():
        drive, _, how = label.partition(", ")
        for case, one in cases.items():
            row = rows.setdefault(f"{drive}, {case}", {})
            if label.endswith(OF_TRUTH):
                row[TRUTH] = truths_ratio(cases, case)
                continue
            row["refined" if how.startswith("refined") else "as calibrated"] = one["t_rel_percent"]
            row["length"] = one["scale"]
            if "peer_scale" in one:
                row["ORB-SLAM3"], row["its length"] = one["peer_t_rel_percent"], one["peer_scale"]
    return rows


def truths_ratio(one: Found, row: str = "as it is") -> str | None:
    """The error of the truth over the segments of t_rel, by ours and the peer of all rows."""
    if row not in one:
        return None
    return cell_of(one[row]["t_rel"]["translation"]["by_three"][PEERS[0]]["truth"], " %")


def cell_of(one: Found, unit: str = "") -> str:
    """An error with its interval; below the end of the interval if it is not resolved."""
    ends, error = one["interval"], one["error"]
    if error is None:
        return "not resolved" if ends is None else f"< {ends[1]:.2f}{unit}, not resolved"
    return f"{error:.2f}{'' if ends is None else f' ({ends[0]:.2f}–{ends[1]:.2f})'}{unit}"


def three_paths(found: Found) -> Rows:
    """By length of segment; components at the longest length that has intervals."""
    rows: Rows = {}
    for label, drive in found.items():
        name, how = label.removesuffix(OF_TRUTH).partition(" (")[0], drive["as it is"]
        lengths = {key: how[key] for key in SHOWN if key in how}
        apart = [m for m, one in lengths.items() if m != "t_rel" and known(one)]
        for m, one in lengths.items():
            where = f"{name}, {m}" if m == "t_rel" else f"{name}, {m} m"
            counts = {"segments": one["segments"], "side by side": one["independent"]}
            rows[where] = {**counts, **errors(one["translation"])}
            if apart and m == apart[-1]:
                for part in ("along", "across", "up"):
                    rows[f"{where}, {part}"] = errors(one[part])
                rows[f"{where}, rotation"] = errors(one["rotation"], " °/100 m")
    return rows


def known(one: Found) -> bool:
    return any(each["interval"] for each in one["translation"]["errors"].values())


def alone(path: str, peer: str) -> str:
    return f"{path}, by {peer} alone"


def errors(one: Found, unit: str = " %") -> dict[str, str]:
    cells = {path: cell_of(each, unit) for path, each in one["errors"].items()}
    cells["ours to truth"] = cell_of(one["differences"]["truth, ours"], unit)
    for peer, three in one["by_three"].items():
        cells |= {alone(path, peer): cell_of(three[path], unit) for path in ("truth", "ours")}
    return {**cells, "share errors": "; ".join(one["not_independent"])}
