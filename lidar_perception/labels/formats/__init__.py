"""One file a format of labels: read(path, frames) and write(labels, out, frames)."""
