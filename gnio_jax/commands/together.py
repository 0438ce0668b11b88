"""Options of the commands that several processes may run together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from gnio_jax.scaling.meeting import Meeting


@dataclass(frozen=True)
class MeetingOptions:
    """Where and how the processes meet."""

    coordinator: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Where process 0 listens for the others; not needed under Slurm, Open MPI and Kubernetes."""
    processes: int | None = None
    """How many processes work together, with --coordinator."""
    process_id: int | None = None
    """Which of them this one is, counted from 0, with --coordinator."""
    patience: int = 120
    """Seconds after which a process that does not come, or gives no sign of life, is given up."""

    def meeting(self) -> Meeting:
        """Where the processes meet."""
        return Meeting(self.coordinator, self.processes, self.process_id, self.patience)
