"""Running things: files, processes, resuming, the terminal."""
