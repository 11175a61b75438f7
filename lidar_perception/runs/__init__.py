"""Support for long-running commands: files, processes, resuming, terminal output, compilation."""
