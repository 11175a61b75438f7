"""The protocol of nuScenes' detection task."""
