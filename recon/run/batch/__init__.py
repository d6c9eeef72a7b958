"""Many commands as jobs, on this machine or on a cluster."""
