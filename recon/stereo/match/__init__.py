"""From a rectified pair to a disparity for each pixel.

- `protocol.py`: what every matcher gives; `registry.py`: the matchers by name;
- `search.py`: the range that is searched, and what is done with what was found;
- `scratch.py`: memory that is kept from pair to pair; `range.py`: a range where none is known.

`sad.py` compares gradients (`gradients.py`) in windows: the cost is in `kernels/half_windows.py`,
the best candidate in `kernels/sad.py`, and `kernels/tiles.py` says which candidates are tried.
`sgm.py` adds census and paths: the cost is in `kernels/path_costs.py` and `kernels/census.py`, the
paths are in `kernels/semi_global.py`. Of both, `kernels/refine.py` checks what was found, and says
why a pixel has no disparity.

Other matchers: `opencv.py`, `onnx.py`, `foreign.py` (from other packages), `half_size.py` (rough).
"""
