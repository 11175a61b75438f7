"""Labels of drives, and their conversion from and to the formats of other tools and data sets."""
