"""Labels of drives, and their import and export in the formats of other tools and data sets."""
