"""Running a detector over a recording and writing its results, as files and as pictures."""
