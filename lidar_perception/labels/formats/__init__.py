"""One module per label format, with read(path, frames) and write(labels, out, frames)."""
