"""Pictures of clouds and boxes without a GPU or a browser: a small rasterizer in NumPy."""
