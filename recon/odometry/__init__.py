"""From frames to poses: a visual prior and a kiss-icp correction that must earn its place."""
