"""Real-time UAV tracking on a CPU: SiamFC++ (AlexNet) compressed by rank-based filter pruning."""

__version__ = "0.1.0"
