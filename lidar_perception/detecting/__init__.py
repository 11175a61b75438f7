"""Detection in all frames of a recording, with results as files, pictures and videos."""
