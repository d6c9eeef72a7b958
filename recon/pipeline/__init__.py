"""The stages in order: configuration, frames, sequences, products, run directory."""
