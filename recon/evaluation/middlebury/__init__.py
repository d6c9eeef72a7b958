"""The Middlebury stereo benchmark: scenes, scores and results of other programs.

- `scenes.py`: the scenes of a folder, and results of other programs for them;
- `score.py`: the rules of the benchmark, and the figures of one result;
- `bench.py`: each scene matched and scored, and the figures of all.
"""
