"""The experiments of the seed paper, repeated and corrected.

- `scenes.py`: what they are of; `methods.py`: what is compared, with `printed.py` as the paper has
  it; `result.py`: figures and files.
"""
