"""From posed clouds to the map: fusion, occupancy, ground, and the store that keeps them."""
