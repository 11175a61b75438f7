"""Report on a measured sensor: values, warnings and files."""
