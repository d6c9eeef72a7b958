"""Reports of runs: one self-contained HTML file for each, its figures and its tables."""
