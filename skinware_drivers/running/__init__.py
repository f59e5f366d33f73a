"""Run a driver: open its buses, take and decode frames, publish snapshots when they are due."""
