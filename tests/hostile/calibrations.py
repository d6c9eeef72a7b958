"""Valid calibration files of all formats, and what can be wrong with them."""

from typing import Final

OURS: Final = """\
format: recon-calibration
version: 1
kind: rectified
camera: {width_px: 48, height_px: 32, focal_px: 50.0, cx_px: 24.0, cy_px: 16.0, cx_right_px: 24.0,
  baseline_m: 0.1}
"""
KITTI: Final = "P0: 50 0 24 0 0 50 16 0 0 0 1 0\nP1: 50 0 24 -5 0 50 16 0 0 0 1 0\n"
MIDDLEBURY: Final = """\
cam0=[50 0 24; 0 50 16; 0 0 1]
cam1=[50 0 24; 0 50 16; 0 0 1]
doffs=0
baseline=100
width=48
height=32
ndisp=16
"""


def _matrix(name: str, rows: int, cols: int, data: str) -> str:
    size = f"   rows: {rows}\n   cols: {cols}\n"
    return f"{name}: !!opencv-matrix\n{size}   dt: d\n   data: [ {data} ]\n"


_LENS: Final = "50., 0., 24., 0., 50., 16., 0., 0., 1."
OPENCV: Final = "%YAML:1.0\n---\nimage_width: 48\nimage_height: 32\n" + "".join(
    _matrix(*each)
    for each in (
        ("M1", 3, 3, _LENS),
        ("D1", 1, 4, "0., 0., 0., 0."),
        ("M2", 3, 3, _LENS),
        ("D2", 1, 4, "0., 0., 0., 0."),
        ("R", 3, 3, "1., 0., 0., 0., 1., 0., 0., 0., 1."),
        ("T", 3, 1, "-0.1, 0., 0."),
    )
)
_CHAIN: Final = """\
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [50.0, 50.0, 24.0, 16.0]
  resolution: [48, 32]
"""
KALIBR: Final = f"""\
cam0:
{_CHAIN}cam1:
{_CHAIN}  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
CAMERA_INFO: Final = """\
image_width: 48
image_height: 32
camera_matrix: {rows: 3, cols: 3, data: [50, 0, 24, 0, 50, 16, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [50, 0, 24, SHIFT, 0, 50, 16, 0, 0, 0, 1, 0]}
"""
VALID: Final = {
    "ours": ("rig.yaml", OURS),
    "kitti": ("calib.txt", KITTI),
    "middlebury": ("calib.txt", MIDDLEBURY),
    "opencv": ("stereo.yml", OPENCV),
    "kalibr": ("chain.yaml", KALIBR),
    "camera-info": ("rig_right.yaml", CAMERA_INFO.replace("SHIFT", "-5")),
}

#: Values in place of a number: what YAML makes of them, and what float() and int() do.
NUMBERS: Final = {
    "date": "2020-13-45",
    "time": "2020-01-01 25:61:61",
    "tag int abc": "!!int abc",
    "tag float abc": "!!float abc",
    "tag timestamp x": "!!timestamp x",
    "tag binary x": "!!binary x",
    "tag python": "!!python/object/apply:os.getcwd []",
    "5000 digits": "1" * 5000,
    "400 digits": "1" * 400,
    "1e400": "1e400",
    "1e300": "1e300",
    "1e-300": "1e-300",
    "minus 1e300": "-1e300",
    "nan": ".nan",
    "inf": ".inf",
    "list": "[1, 2]",
    "ragged list": "[1, [2, 3]]",
    "map": "{a: 1}",
    "null": "null",
    "word": "word",
    "zero": "0",
    "negative": "-5",
    "arabic digits and a letter": "٣x",
    "superscript": "²",
    "sexagesimal": "190:20:30",
    "alias to itself": "&a [*a]",
    "alias to itself by name": "&a {b: *a}",
    "unknown alias": "*b",
}


def replace_one(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


def deep(levels: int) -> dict[str, str]:
    storage = "<?xml version='1.0'?>\n<opencv_storage>\n"
    opencv = "%YAML:1.0\n---\n"
    hidden = '[ "]", ' * levels
    return {
        "yaml lists": f"cam0: {'[' * levels}{']' * levels}\n",
        "yaml open lists": f"cam0: {'[' * levels}\n",
        "yaml maps": f"cam0: {'{a: ' * levels}1{'}' * levels}\n",
        "yaml dashes": f"cam0:\n  {'- ' * levels}1\n",
        "opencv yaml lists": f"{opencv}M1: {'[' * levels}{']' * levels}\n",
        "opencv yaml open lists": f"{opencv}M1: {'[' * levels}\n",
        "opencv yaml maps": f"{opencv}M1: {'{a: ' * levels}1{'}' * levels}\n",
        "opencv yaml dashes": f"{opencv}M1:\n   {'- ' * levels}1\n",
        "opencv yaml, closed only in text": f"{opencv}M1: {hidden}\n",
        "opencv xml": f"{storage}{'<a>' * levels}1{'</a>' * levels}</opencv_storage>\n",
        "opencv xml, not closed": f"{storage}{'<a>' * levels}",
        "opencv xml, closed only in comments": f"{storage}{'<a><!--</a>-->' * levels}",
        "opencv json": f'{{"opencv-matrix": {"[" * levels}1{"]" * levels}}}\n',
        "ours": f"format: recon-calibration\nversion: {'[' * levels}{']' * levels}\n",
    }


#: Lines of YAML that expand to 10^10 values.
EXPANDING: Final = (
    "l0: &l0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]",
    *(f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]" for n in range(1, 10)),
)
