"""Label formats, one module each, with read(path, frames) and write(labels, out, frames)."""
