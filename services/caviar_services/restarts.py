"""The exit status of a service that is started again whenever its status is not 0, as containers are."""

from __future__ import annotations

from caviar_protocol.messages import RUN_COMPLETE, STOPPED_BY
from caviar_services.termination import TERMINATED


def restart_status(status: int, ended: str) -> int:
    """Status 0 where the work is done or nobody wants it any more; 1 where another run may follow.

    Parameters
    ----------
    status
        What the runner returned.
    ended
        Why the broker ended the run; "" where it did not.
    """
    if status == TERMINATED:
        return 0
    failed = bool(ended) and ended != RUN_COMPLETE and not ended.startswith(STOPPED_BY)
    return 1 if failed else status
