"""Values, warnings and files about a measured sensor."""
