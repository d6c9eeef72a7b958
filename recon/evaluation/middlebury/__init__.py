"""The Middlebury stereo benchmark: scenes, scores and results of other programs.

- `scenes.py`: the scenes of a folder, and results of other programs for them;
- `bench.py`: one scene matched and scored; `rules.py`: the measures of the benchmark;
- `score.py`: the figures of one result; `summary.py`: those of all scenes.
"""
