"""The Middlebury stereo benchmark: scenes, scores and results of other programs."""
