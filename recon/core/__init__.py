"""What every room stands on: values, geometry, errors, settings, compiled loops."""
