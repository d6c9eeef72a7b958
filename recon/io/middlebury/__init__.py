"""Middlebury stereo scenes of 2001 to 2014, and MiddEval3."""
