"""Labels of drives: one type, and the formats of other tools and data sets in and out."""
