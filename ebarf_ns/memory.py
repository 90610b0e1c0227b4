"""How much memory a run has taken."""

import sys
from pathlib import Path

import torch

try:
    import resource
except ImportError:  # Windows
    resource = None


def peak_memory_mib(device: str = "cpu") -> float:
    """Most memory held at once since the process began: on a GPU by torch, else by the process; 0 where the system does
    not tell."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**20
    status = Path("/proc/self/status")
    if status.is_file():
        # What getrusage says includes the parent of a process, from before it became a program of its own.
        lines = status.read_text(encoding="utf-8").splitlines()
        for line in lines:
            if line.startswith("VmHWM"):
                return int(line.split()[1]) / 1024
    if resource is None:
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
