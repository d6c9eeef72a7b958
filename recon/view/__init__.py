"""A map in the browser, on this machine alone.

`scene.py`: what is shown, as values; `follow.py`: the scene of a map, also of one that grows, and
what its keyframes saw; `server.py`: the page, the only file that knows viser; `door.py`:
where a browser asks for a run that lasts.
"""
