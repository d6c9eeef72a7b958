"""The rows of each table of results, made of what its commands print.

Each function takes the printed JSON by the names of the commands, and gives the cells by label and
heading; headings without a cell stay empty.
"""

from __future__ import annotations

from math import hypot
from statistics import median

from result_drift_rows import OF_TRUTH, TRUTH, Found, Rows, truths_ratio


def lidar(found: Found) -> Rows:
    names = {
        "precision": "precision",
        "recall": "recall",
        "F": "f_score",
        "precision in reach": "precision_in_reach",
        "F in reach": "f_score_in_reach",
    }
    return {
        label: {heading: one[key] for heading, key in names.items()} for label, one in found.items()
    }


def disparities(found: Found) -> Rows:
    """Medians by depth, and what parts of the image are off."""
    return {
        name: {f"{depths} m": error for depths, error in one["by_depth_m"].items()}
        | {"parts, rms": one["parts_rms"], "largest": one["largest_of_parts"]}
        | {"LiDAR moved": hypot(*one["moved_mm"]), "turned": hypot(*one["turned_deg"])}
        for name, one in found[""].items()
    }


def depths(found: Found) -> Rows:
    """By depth, in per cent: points given, right, and wrong among as many as all give."""
    shown = ("given", "right", "wrong of surest")
    return {
        f"`{matcher}`": {
            f"{metres} m": " / ".join(f"{100 * one[name]:.0f}" for name in shown)
            for metres, one in by_depth.items()
        }
        for matcher, by_depth in found[""].items()
    }


def planted(found: Found) -> Rows:
    rows: Rows = {}
    for drive, faults in found.items():
        if drive.endswith(OF_TRUTH):
            continue
        ratio, without = found.get(f"{drive}{OF_TRUTH}", {}), faults["none"].get("t_rel_percent")
        for name, one in faults.items():
            if name == "none":
                continue
            row = rows[f"{drive}, {name}"] = {
                "planted": one["planted_px"],
                "left": one["left_px"],
                "recovered": one["recovered_percent"],
            }
            if without is not None:
                row |= {"t_rel": one["t_rel_percent"], "without it": without}
                row[TRUTH] = truths_ratio(ratio)
    return rows


def degraded(found: Found) -> Rows:
    return {
        case: {
            f"`{odometry}` {heading}": one[key]
            for odometry, one in both.items()
            for heading, key in (("t_rel", "t_rel_percent"), ("not trusted", "untrusted"))
        }
        for case, both in found["street"].items()
    }


def intervals(found: Found) -> Rows:
    one = found["streets"]
    return {
        "rendered streets": {
            "drives": one["drives_that_count"],
            "segments within their 95 % interval": 100 * one["covered"],
            "error over stated deviation, rms": one["rms_sigmas"],
        }
    }


def rig_intervals(found: Found) -> Rows:
    one = found["streets"]
    held = {name: 100 * ratio for name, ratio in one["held"].items()}
    return {
        f"{len(one['drives'])} rendered drives": {
            **held,
            "not recovered": 100 * one["not_recovered"],
        }
    }


def drive_meshes(found: Found) -> Rows:
    return {
        f"{drive}, `{way}`": figures
        for drive, ways in found.items()
        for way, figures in ways.items()
    }


def occupancy(found: Found) -> Rows:
    return {f"street {seed}": one for seed, one in found["streets"]["streets"].items()}


def traversability(found: Found) -> Rows:
    """Free / graded / obstacle / unknown in percent, by kind and distance."""
    rows: Rows = {}
    for vehicle, one in found["courses"].items():
        rows[vehicle] = {
            "over, free": one["over the limit, free within 12 m"],
            "over, to 50": one["over the limit, cost to 50 within 12 m"],
            "over, above 50": one["over the limit, cost above 50 within 12 m"],
            "ramps, obstacle": one["ramps up to 15 %, obstacle"],
        }
        for kind, bands in one["cells"].items():
            rows[f"{vehicle}, {kind}"] = {band: quarters(cells) for band, cells in bands.items()}
    return rows


def quarters(cells: dict[str, int]) -> str | None:
    graded = cells.get("low", 0) + cells.get("high", 0)
    counted = [cells.get("free", 0), graded, cells.get("obstacle", 0), cells.get("unknown", 0)]
    return " / ".join(f"{100 * n / sum(counted):.0f}" for n in counted) if any(counted) else None


def costs_lidar(found: Found) -> Rows:
    """Cells of each kind, by what LiDAR says of them."""
    rows: Rows = {}
    for drive, parts in found.items():
        for part, kinds in parts.items():
            for kind, cells in kinds.items():
                total = sum(cells.values())
                usable = 100 * (cells["free"] + cells["graded"]) / total
                rows[f"{drive}, {kind}, {part}"] = {"cells": total, "0 to 99": usable, **cells}
    return rows


def loops(found: Found) -> Rows:
    rows: Rows = {}
    for block, both in found.items():
        for drive, added in (("block", ""), ("drift", ", 1 % and 1°/100 m added")):
            row = {"loops": both[drive]["loops"]["closed"]}
            for when in ("before", "after"):
                one = both[drive][when]
                row |= {
                    f"end {when}": one["end_error_m"],
                    f"ATE {when}": one["aligned_rms_error_m"],
                    f"F {when}": one["cloud"][0]["f_score"],
                }
            rows[f"{block}{added}"] = row
    return rows


def rooms(found: Found) -> Rows:
    each = found["rooms"]["rooms"]
    placed, frames, loops, wrong = (
        sum(one[key] for one in each) for key in ("frames_placed", "frames", "loops", "wrong")
    )
    ate = [one["ate_percent"] for one in each]
    return {
        f"{len(each)} rooms": {
            "frames in the map": 100.0 * placed / frames,
            "ATE, median": median(ate),
            "ATE, worst": max(ate),
            "laps closed": sum(one["laps_closed"] for one in each),
            "loops": loops,
            "wrong": wrong,
        }
    }


def localized(found: Found) -> Rows:
    return {
        case: {
            "tracked": 100 * one["tracking"] if "tracking" in one else None,
            "median": 100 * one["median_m"] if "median_m" in one else None,
            "95 %": 100 * one["p95_m"] if "p95_m" in one else None,
            "largest": 100 * one["max_m"] if "max_m" in one else None,
            "angle": one.get("median_deg"),
            "off by 0.5 m": one.get("wrong"),
        }
        for case, one in found["drive"].items()
        if case != "growth"
    }


def second_day(found: Found) -> Rows:
    return {
        f"{how}: {cloud}": {
            "precision": one["precision"],
            "recall": one["recall"],
            "F": one["f_score"],
            "points on cars that left": one["points_of_cars_that_left"],
        }
        for how, both in found.items()
        for cloud, one in both["second"]["clouds"].items()
    }


def halves(found: Found) -> Rows:
    one = found["halves"]["halves"]
    return {
        "kitti_raw_0013": {
            "t_rel, one run": one["t_rel_percent"]["one run"],
            "merged": one["t_rel_percent"]["merged"],
            TRUTH: truths_ratio(found["truth"]),
            "paths apart": 1000 * one["path_apart_m"],
            "cells that differ": 100 * one["grid"]["differ"],
            "free against occupied": 100 * one["grid"]["free_against_occupied"],
        }
    }


def movers(found: Found) -> Rows:
    return {
        street + ("" if whose == "recon" else ", DUFOMap"): {
            "moving points": one["moving_points"],
            "of them gone": percent(one["moving_gone"]),
            "of static ones lost": percent(one["static_lost"]),
            "of posts and lamps": percent(one["thin_lost"]),
        }
        for street, both in found.items()
        for whose, one in both.items()
        if whose in ("recon", "dufomap")
    }


def percent(ratio: float | None) -> float | None:
    return None if ratio is None else 100 * ratio


def matching(found: Found) -> Rows:
    rows: Rows = {}
    for threads, one in found.items():
        for size in one["sizes"]:
            label = f"{size['height']}×{size['width']}, {size['ndisp']} disparities, {threads}"
            rows[label] = dict(size["ratios"])
    return rows


def mapping(found: Found) -> Rows:
    names = {
        "frames per second": "fps",
        "whole run": "whole_run_s",
        "processor": "processor_s",
        "memory": "peak_memory_mb",
    }
    return {
        drive: {heading: one["drive"][key] for heading, key in names.items()}
        for drive, one in found.items()
    }


def rays(found: Found) -> Rows:
    return {
        f"{row['scene']}, {row['resolution_m']:g} m": {
            "times as fast": row["octomap / recon"],
            "same occupied cells": 100 * row["agreement"]["occupied"],
            "same free cells": 100 * row["agreement"]["free"],
        }
        for row in found["rays"]["ray_casting"]
    }


def live(found: Found) -> Rows:
    one = found["drive"]
    return {
        f"{float(rate) * 10:g} Hz": {
            "p50": played["latency_ms"]["p50"],
            "p95": played["latency_ms"]["p95"],
            "largest": played["latency_ms"]["max"],
            "dropped": played["frames_dropped"],
            "tracked, not matched": played["frames_not_matched"],
            "t_rel": played["t_rel_percent"],
            TRUTH: truths_ratio(found["truth"]),
            "memory": played["peak_memory_mb"],
        }
        for rate, played in one["rates"].items()
    }


def ros2(found: Found) -> Rows:
    one = found["drive"]
    rows: Rows = {"image of 466 kB to an array": one["image_ms"]}
    for name, played in (("recording", one["files"]), ("topics", one["ros2"])):
        used = {"dropped": "frames_dropped", "cores": "cores", "memory": "peak_memory_mb"}
        cost = {column: played[key] for column, key in used.items()}
        rows[f"{name}: image to pose"] = {**played["latency_ms"], **cost}
    return {**rows, "topics: stamp to a listener": one["ros2"]["to_listener_ms"]}


def memory(found: Found) -> Rows:
    one = found["street"]
    rows = {
        f"{row['frames']} frames": {
            "recon map": row["peak_mb"],
            **{f"recon {name}": again["peak_mb"] for name, again in row["again"].items()},
        }
        for row in one["drives"]
    }
    return {"libraries": {"recon map": one["libraries"]["peak_mb"]}, **rows}


def scheduler(found: Found) -> Rows:
    return {
        f"{row['workers']} workers, {row['jobs']} jobs": {
            "ms per job": row["scheduler_ms_per_job"],
            "jobs per second at most": row["jobs_per_second_at_most"],
        }
        for row in found["sleeping"]["rows"]
    }


def recordings(found: Found) -> Rows:
    """What each recording gives, and what ORB-SLAM3 and COLMAP make of the same frames."""
    rows: Rows = {}
    for name, one in found["recordings"].items():
        peers = {
            head: one.get(key) for head, key in (("ORB-SLAM3", "orbslam3"), ("COLMAP", "colmap"))
        }
        refusal = one.get("product")
        rows[f"{name}: {one['place']}"] = {
            "camera": one.get("camera"),
            "map": refusal or f"{one['frames']} frames, {one['length_m']:.1f} m",
            "not trusted": one.get("lost"),
            "ATE": centimetres(one),
            "precision": one.get("precision"),
            "recall": one.get("recall"),
            "ORB-SLAM3": None if refusal else peer_cell(peers["ORB-SLAM3"]),
            "COLMAP": None if peers["COLMAP"] is None else centimetres(peers["COLMAP"]),
        }
    return rows


def year(found: Found) -> Rows:
    """What a map costs and finds at the begin and after the last week, by what it keeps."""
    rows: Rows = {}
    for name, weeks in found["year"]["maps"].items():
        last = max(weeks, key=int)
        before = weeks[str(int(last) - 1)]
        rows[name] = {
            "weeks": len(weeks),
            "map after the first": weeks["0"]["megabytes"],
            "after the last": weeks[last]["megabytes"],
            "second added in": weeks["1"].get("seconds"),
            "last in": weeks[last].get("seconds"),
            "last found at 3 cm": before.get("found_percent"),
            "off": None if "off_m" not in before else 100 * before["off_m"],
        }
    return rows


def changes(found: Found) -> Rows:
    """What a comparison of two weeks finds of what was parked, by weeks."""
    return {
        f"weeks {one['weeks'][0] + 1} and {one['weeks'][1] + 1}": {
            "cars that came or went": "{} of {}".format(*one["found_of"]["free"]),
            "replaced": "{} of {}".format(*one["found_of"]["replaced"]),
            "objects": one["objects"],
            "false": len(one["false"]),
            "not compared": 100 * max(one["not_compared"].values()),
        }
        for one in found["changes"]["weeks"]
    }


def unchanged(found: Found) -> Rows:
    """What a comparison of two halves of a drive finds, by drive."""
    rows: Rows = {}
    for one in found["changes"]["drives"]:
        volume = one["volume"]
        rows[one["drive"]] = {
            "path": one["path_m"],
            "objects": one["objects"],
            "not compared": 100 * max(one["not_compared"].values()),
            "volume": f"{volume['net_m3']:.1f} ± {volume['sigma_m3']:.1f} m³",
            "height": 1e3 * volume["net_m3"] / volume["compared_m2"],
            "area": volume["compared_m2"],
            "cut": volume["cut_m3"],
            "fill": volume["fill_m3"],
        }
    return rows


def surfaces(found: Found) -> Rows:
    """How much of what is seen at a depth a map has, and how much of it is right."""
    return {
        name: {
            "points": one["points"],
            "reach": one["reach_m"],
            "precision": one["precision"],
            "recall 0 to 2 m": one["recall 0 to 2 m"],
            "2 to 4 m": one["recall 2 to 4 m"],
            "4 to 6 m": one["recall 4 to 6 m"],
        }
        for name, one in found.items()
    }


def centimetres(one: Found) -> str | None:
    """The error of a path."""
    return None if one.get("ate_m") is None else f"{100 * one['ate_m']:.2g} cm"


def peer_cell(one: Found | None) -> str:
    """What a peer reached: its error, or how many frames it lost."""
    if one is None:
        return "not run"
    lost = f"{one['lost']} lost" if "lost" in one else ""
    return ", ".join(part for part in (centimetres(one), lost) if part)


def weather(found: Found) -> Rows:
    """Frames lost, the error of the path, and what is matched, beside ORB-SLAM3."""
    return {
        name: {
            "frames": ours["frames"],
            "lost": ours["lost"],
            "ATE": 100 * ours["ate_m"],
            "t_rel": ours["t_rel_percent"],
            "matched": ours["valid_percent"],
            "of it wrong": ours["wrong_percent"],
            "ORB-SLAM3 lost": None if peer is None else peer["lost"],
            "its ATE": 100 * peer["ate_m"] if peer and "ate_m" in peer else None,
            "its t_rel": peer.get("t_rel_percent") if peer else None,
        }
        for name, both in found["street"].items()
        for ours, peer in [(both["recon"], both["orbslam3"])]
    }


def light(found: Found) -> Rows:
    """Bad 2 by what was done to the right image."""
    return {
        light: {f"`{matcher}`": bad for matcher, bad in one.items()}
        for light, one in found["pairs"].items()
    }
