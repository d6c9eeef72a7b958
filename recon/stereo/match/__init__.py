"""From a rectified pair to a disparity for each pixel: the matchers by name in `registry.py`.

`protocol.py` has what every matcher gives, `search.py` what matchers over a range share, `light.py`
evens light before ours compare. `sad.py` also finds a range where none is known, and rough
disparities at half size; its costs are in `kernels/half_windows.py`, those of `sgm.py` in
`kernels/path_costs.py`. Of both, `kernels/refine.py` checks what was found, and says why a pixel
has no disparity. `fine.py` adds costs that a network knows (`kernels/convolution.py`) and a search
among planes (`kernels/planes.py`), also those of whole segments, with which `fill.py` fills what
any matcher did not find. `onnx.py` runs the networks of others (`network.py`), rates what both
views find, and says what is known of those that are published.
"""
