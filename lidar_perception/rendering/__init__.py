"""Rendering of clouds and boxes with a small rasterizer in NumPy, without a GPU or a browser."""
