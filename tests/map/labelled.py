"""A program with one attribute more: ``python -m tests.map.labelled FOLDER``.

The table gets a row, and clouds a field, before anything else of the library is imported; nothing
else is changed. It maps a wall whose points have labels, one in five of them wrong, and writes what
becomes of them into the folder.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import machinery
from pathlib import Path
from types import CodeType, ModuleType

ROW = """    Attribute(
        "label", np.uint8, fused="vote", values=8, ply=("label",), pcd=("label",), las=("label",),
        ros=("label",), view="label", scale="tab10",
    ),
)  # fmt: skip"""
CHANGES = {
    "recon.core.values.cloud": [
        (")  # fmt: skip", ROW),
        (
            '    frame: Frame = "camera"',
            '    label: UInt8 | None = None\n    frame: Frame = "camera"',
        ),
    ],
}
LOW, HIGH = 2, 5  # labels of the lower and of the upper half of the wall


class Changed(machinery.SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        source = self.get_source(fullname) or ""
        for before, after in CHANGES[fullname]:
            assert source.count(before) == 1
            source = source.replace(before, after)
        return compile(source, self.path, "exec", dont_inherit=True)


class Finder:
    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> machinery.ModuleSpec | None:
        spec = machinery.PathFinder.find_spec(name, path) if name in CHANGES else None
        if spec is not None and spec.origin is not None:
            spec.loader = Changed(name, spec.origin)
        return spec


def main(folder: Path) -> None:
    import numpy as np

    from recon.commands.config import load_config
    from recon.core.values import join_clouds
    from recon.io.models.columns import write_npz, write_pcd
    from recon.io.models.las import write_las
    from recon.io.models.ply import read_ply, write_ply
    from recon.io.ros.messages import header, points
    from recon.map.map import Map
    from recon.map.sessions.copying import keep_map
    from recon.report.scene import COLOURINGS, Points, colours
    from recon.stereo.frame import voxel_downsample
    from tests.map import walls

    plain = walls.wall

    def labelled(T_true, seed):
        cloud = plain(T_true, seed)  # camera axes: y is down
        rng = np.random.default_rng(seed)
        label = np.where(cloud.xyz[:, 1] > 0, LOW, HIGH)
        wrong = rng.random(len(cloud)) < 0.2
        label = np.where(wrong, rng.integers(0, 8, len(cloud)), label)
        return replace(cloud, label=label.astype(np.uint8))

    with Map.temporary() as made:
        walls.wall = labelled
        changes = ["submaps.length_m=8", "fusion.voxel_m=0.4", "map_filters.radius_m=none"]
        config = load_config(None, changes)
        walls.drive(made, walls.TRUE[0], 0, config=config)
        walls.wall = plain
        walls.drive(made, walls.TRUE[1], 1, "without labels")
        made.commit()
        keep_map(made, folder / "map.recon")
    with Map.open(folder / "map.recon") as map_:
        cloud = walls.cloud_of(map_.tiles())
        known_of_both = [map_.session(n).submaps[0].fused.known for n in (0, 1)]
    up = cloud.xyz[:, 2]
    sure = np.abs(up) > 0.3  # else a voxel has points of both halves
    write_ply(folder / "cloud.ply", cloud)
    write_pcd(folder / "cloud.pcd", [cloud])
    write_las(folder / "cloud.las", [cloud], np.eye(4))
    write_npz(folder / "cloud.npz", [cloud.arrays], {})
    thin = voxel_downsample(cloud, 1.0)
    seen = points(header("map", 0), cloud)[1]
    found = {
        "points": len(cloud),
        "right": float(np.mean(cloud.label[sure] == np.where(up[sure] < 0, LOW, HIGH))),
        "known": [list(known) for known in known_of_both],
        "read": bool(np.array_equal(read_ply(folder / "cloud.ply").label, cloud.label)),
        "thinned": sorted({*thin.label.tolist()}),
        "joined": join_clouds([cloud, cloud]).label.tolist() == 2 * cloud.label.tolist(),
        "sent": [(one["name"], one["datatype"]) for one in seen["fields"]],
        "colourings": list(COLOURINGS),
        "drawn": len({*map(tuple, colours([Points("wall", cloud)], "label")[0][0].tolist())}),
    }
    (folder / "found.json").write_text(json.dumps(found))


if __name__ == "__main__":
    sys.meta_path.insert(0, Finder)  # type: ignore[arg-type]
    main(Path(sys.argv[1]))
