"""Text, pictures and files about a measured sensor."""
