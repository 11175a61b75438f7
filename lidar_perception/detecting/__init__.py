"""Detection in a whole recording, with results as files and as pictures."""
