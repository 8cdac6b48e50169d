"""Run time against error, stage by stage, ours beside the peers."""
