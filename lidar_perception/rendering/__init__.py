"""Rendering of clouds and boxes without a GPU or a browser, by a small rasterizer in NumPy."""
