"""Tasks on the workers of a dask scheduler: several machines that share the scene's folder.

Nothing travels but the tasks themselves: each worker reads the scene from the shared folder
and writes its frames there, whole or not at all, as a run on one machine does. A task that is
given out twice, because its worker seemed or was lost, finds the finished frame and keeps it.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from chromeball.renderer.frames import Outcome, Task, make
from chromeball.scene.errors import UserError
from chromeball.scene.record import content_hash

#: Times that a task is tried again after an error that is not the user's.
RETRIES = 2
#: Seconds to wait for the scheduler and for the first worker.
PATIENCE = 60

#: One picture at a time in a worker: it takes all cores.
_turn = threading.Lock()


def farm_out(
    tasks: Sequence[Task],
    scheduler: str,
    *,
    force: bool = False,
    patience: int | float = PATIENCE,
) -> Iterator[Outcome]:
    """Have workers make the tasks; outcomes as they come, the failed ones with their error.

    The tasks' paths are absolute, and lead workers to the same files.

    Raises
    ------
    UserError
        When there is no such scheduler, it has no workers, or it is lost.

    """
    try:
        import distributed
    except ModuleNotFoundError as missing:
        raise UserError(
            f"--scheduler needs {missing.name}, which is not installed: "
            "pip install 'chromeball[farm]'"
        ) from missing
    library: Any = distributed  # untyped
    try:
        client = library.Client(scheduler, timeout=patience, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(f"no dask scheduler answers at {scheduler}: {error}") from error
    try:
        client.wait_for_workers(1, timeout=patience)
        run = uuid.uuid4().hex[:8]
        prints = {file: content_hash(file) for file in {task.scene_file for task in tasks}}
        futures = {
            client.submit(
                work,
                task,
                prints[task.scene_file],
                force,
                key=f"{task}-{run}".replace(" ", "-"),
                pure=False,
                retries=RETRIES,
            ): task
            for task in tasks
        }
        for future in library.as_completed(futures, loop=client.loop):
            failure = future.exception()
            if failure is None:
                yield future.result()
            else:
                text = f"{type(failure).__name__}: {failure}"
                yield Outcome(futures[future], "failed", error=text)
    except TimeoutError as error:
        raise UserError(
            f"the scheduler at {scheduler} has no workers: start them with "
            f"`dask worker {scheduler} --nthreads 1`"
        ) from error
    except library.client.FutureCancelledError as error:
        raise UserError(f"the scheduler at {scheduler} was lost: run it again") from error
    finally:
        client.close()


def work(task: Task, scene_hash: str, force: bool) -> Outcome:
    """What a worker does: one task; a user's mistake is an outcome, not worth trying again."""
    with _turn:
        try:
            if not Path(task.scene_file).is_file():
                raise UserError(
                    "this worker does not see the scene: share its folder under one path",
                    file=task.scene_file,
                )
            if content_hash(task.scene_file) != scene_hash:
                raise UserError(
                    "this worker sees another scene file: share one folder",
                    file=task.scene_file,
                )
            return make(task, force=force)
        except UserError as error:
            return Outcome(task, "failed", error=str(error))
