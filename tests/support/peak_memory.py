"""The most memory that a process holds."""

from pathlib import Path

from pointsplat_ns.system.memory import give_back_freed_memory


class PeakMemory:
    """The most memory that this process holds from here on, as Linux counts it (resident, freed memory given back
    first)."""

    def __init__(self) -> None:
        self._known = False
        give_back_freed_memory()
        try:
            Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark to what is resident now
            self._known = True
        except (OSError, AttributeError, TypeError):
            pass  # another system

    def bytes(self) -> int | None:
        """The peak so far; None where it cannot be known."""
        if not self._known:
            return None
        for line in Path("/proc/self/status").read_text("utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
        return None
