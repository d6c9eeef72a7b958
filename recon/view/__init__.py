"""A map in the browser, on this machine alone.

`follow.py`: the scene of a map, also of one that grows, and what its keyframes saw; `server.py`:
the page, made by viser; `tools.py`: what is measured in it; `guard.py`: who is let into it, and
what is taken from it. A scene is what reports draw, too: `report/`.
"""
