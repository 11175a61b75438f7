"""nuScenes: tables, sweeps, labels and result files."""
