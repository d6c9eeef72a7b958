"""From a recorded pair to a cloud: rectification, matching, back-projection."""
