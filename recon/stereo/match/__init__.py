"""From a rectified pair to a disparity for each pixel.

- `protocol.py`: what every matcher gives, and matchers that are not ours; `registry.py`: by name;
- `search.py`: the range that is searched, what is done with what was found, gradients, and memory
  that is kept from pair to pair;

`sad.py` compares gradients in windows; it also finds a range where none is known, and rough
disparities at half size. The cost is in `kernels/half_windows.py`, the best
candidate in `kernels/sad.py`, and `kernels/tiles.py` says which are tried. `sgm.py` adds census
and paths: the cost is in `kernels/path_costs.py`, the paths are in `kernels/semi_global.py`. Of
both, `kernels/refine.py` checks what was found, and says why a pixel has no disparity.

Other matchers: `opencv.py` and `onnx.py`.
"""
