"""Infrastructure of commands: files, processes, resuming, terminal output, compilation."""
