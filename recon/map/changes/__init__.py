"""What came and what went between two sets of drives of one place.

- `compare.py`: the surface of either set, by class: same, came or went, not compared;
- `displaced.py`: what was replaced in its place by something alike, by patches of both days;
- `objects.py`: what changed, in pieces: place, size, volume, and the frames that saw each.
"""
