"""What leaves a map: one module per product."""
