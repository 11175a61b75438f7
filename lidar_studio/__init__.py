"""Labelling of drives, and viewing of recordings and running nodes, in the browser."""
