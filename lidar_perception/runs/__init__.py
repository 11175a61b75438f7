"""Long-running commands: files, processes, resuming, the terminal, compilation."""
