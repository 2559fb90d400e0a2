"""Batches on the workers of Dask: paths and numbers go to them, what is told of each output comes back.

Each worker process makes the batch once, from the arguments that the command itself made it from, and keeps it. It
makes one output at a time, and has a second one to go on with: so it is known at which output a worker ended, what it
had goes to others, and an output at which several workers end is given up alone.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import re
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, get_worker

import lfpiv_cli
from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError, LfpivError, StoppedEarlyError, UsageError
from lfpiv_cli.files.atomic import SECONDS_BETWEEN_LOOKS, Turn
from lfpiv_cli.files.batch import Stamp
from lfpiv_cli.files.inputs import Deadline, reason
from lfpiv_cli.notice import Notice
from lfpiv_cli.threads import told_threads, use_threads
from lfpiv_cli.verbs.batches import Batch

# Workers on this machine, as many as it has cores, or `local:4`.
LOCAL = re.compile(r"local(?::(\d{1,4}))?", re.ASCII)
# An output at which so many workers have ended is given up.
WORKERS_GIVEN_UP = 3
# Of workers on this machine. Dask's own has them give back the memory of each array at once (MALLOC_TRIM_THRESHOLD_),
# which takes half as long again for small frames.
ENVIRONMENT = {"OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1}
# How often it is looked whether workers have come or gone, and for how long a scheduler is asked.
LOOK_S, CONNECT_S = 1.0, 20.0
SCHEDULER_ENDED = "--dask: the scheduler has ended; the same command with --resume goes on"


@dataclass(frozen=True)
class Reply:
    """What a worker tells of an output: what became of it, or the error, what was warned of, and how long it took."""

    made: Any
    notices: Sequence[Notice] = ()
    seconds: float = 0.0


def made_by_workers(
    address: str, batch: Batch[Any], before: Mapping[int, Stamp], deadline: Deadline, work: Frames
) -> Generator[tuple[int, Any], None, None]:
    """Yield outputs with what became of each, as the workers tell it.

    An output at which several workers ended comes last, with the error that says so. Where there is no time for another
    output, those that were begun are the last ones.

    Parameters
    ----------
    address : of a scheduler, or `local`
    before : the numbers of the outputs, and what was in their places when the batch began

    Raises
    ------
    UsageError : there is no scheduler at this address
    StoppedEarlyError : the scheduler has ended
    """
    if not before:
        return
    console = work.console
    kept, local = _Kept(batch, list(before), told_threads() or 1), LOCAL.fullmatch(address)
    with ExitStack() as stack:
        try:
            if local is not None:
                address = stack.enter_context(_own_cluster(int(local[1] or 0)))
            client = stack.enter_context(Client(address, timeout=CONNECT_S, set_as_default=False))
        except (OSError, ValueError) as error:
            raise UsageError(f"--dask {address}: no scheduler answers: {reason(error)}") from error
        client.register_plugin(kept)

        @stack.callback
        def leave() -> None:
            """Have the workers let go of what they keep, if they can be reached."""
            with contextlib.suppress(OSError, ValueError):
                client.unregister_worker_plugin(kept.name)

        if not client.nthreads():
            console.say(f"--dask {address}: waits for workers")
        outputs = _Outputs(client, kept.name, before, batch.names, console)
        try:
            for number, reply in outputs.as_done(deadline):
                console.warn(reply.notices)
                if isinstance(reply.made, LfpivError) and not isinstance(reply.made, InputError):
                    raise reply.made
                deadline.took(reply.seconds)
                yield number, reply.made
        finally:
            outputs.cancel()


class _Kept(WorkerPlugin):
    """What a worker process keeps of a command: its batch, made when the first output is asked for."""

    def __init__(self, batch: Batch[Any], numbers: Sequence[int], threads: int) -> None:
        """Take the batch of the command, which travels as its arguments, and all numbers that will be asked for."""
        self.name = f"lfpiv-{uuid4().hex}"
        self._arguments, self._numbers, self._threads = pickle.dumps(batch), numbers, threads
        self._folder, self._version = Path.cwd(), lfpiv_cli.__version__

    def setup(self, worker: Worker) -> None:
        """Begin in a worker process."""
        self._alone = threading.Lock()
        self._batch: Batch[Any] | None = None

    def make(self, number: int, before: Stamp) -> Reply:
        """Make an output as the command itself would, in its folder; one at a time in each process."""
        warned: list[Notice] = []
        console, begun = Console(quiet=True, warned=warned), time.monotonic()
        made: Any
        with self._alone:
            use_threads(self._threads)
            try:
                if lfpiv_cli.__version__ != self._version:
                    raise UsageError(
                        f"--dask: a worker has lfpiv {lfpiv_cli.__version__}, this command is {self._version}"
                    )
                if not self._folder.is_dir():
                    raise UsageError(f"--dask: a worker does not see {self._folder}: it needs the disk of this command")
                # Paths mean what they mean to the command.
                with contextlib.chdir(self._folder):
                    if self._batch is None:
                        batch: Batch[Any] = pickle.loads(self._arguments)
                        batch.begin(self._numbers, console)
                        self._batch = batch
                    work = Frames(console, 1, 1.0, self._batch.label, self._batch.unit)
                    made = self._batch.attempt(number, before, work)
            except LfpivError as error:
                made = error
        return Reply(made, warned, time.monotonic() - begun)


def _make(name: str, number: int, before: Stamp) -> Reply:
    """Make an output, in a worker process."""
    kept = get_worker().plugins[name]
    assert isinstance(kept, _Kept)
    return kept.make(number, before)


@contextmanager
def _own_cluster(workers: int) -> Iterator[str]:
    """Start a scheduler and workers on this machine, as many as cores are free for them; yields the address."""
    workers = workers or max((os.cpu_count() or 1) // (told_threads() or 1), 1)
    with (
        tempfile.TemporaryDirectory(prefix="lfpiv-dask-", ignore_cleanup_errors=True) as folder,
        dask.config.set({"distributed.nanny.pre-spawn-environ": ENVIRONMENT}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # a worker may take what the command itself might
            dashboard_address="127.0.0.1:0",  # a port of its own, for this machine alone
            local_directory=folder,
            silence_logs=logging.CRITICAL,  # what matters of them is told as a warning
        ) as cluster,
    ):
        yield cluster.scheduler_address


class Runs:
    """Frames that are left, for workers of which each goes on with the next frame after its last.

    So what neighbouring frames have in common, a pair or the frames of a background, is mostly read by one worker.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        """Take the numbers of the frames, in their order."""
        self._numbers = list(numbers)
        self._left = set(range(len(self._numbers)))
        # The place in the order that each worker was given last.
        self._last: dict[str, int] = {}

    def __len__(self) -> int:
        """Return how many frames are left."""
        return len(self._left)

    def next_for(self, worker: str) -> int:
        """Return the next frame for a worker, of which there are some left."""
        place = self._last.get(worker, -1) + 1
        if worker not in self._last or place not in self._left:
            # Where the longest run that is left begins, or its middle if somebody else comes to its begin.
            runs: list[list[int]] = []
            for left in sorted(self._left):
                if runs and left == runs[-1][-1] + 1:
                    runs[-1].append(left)
                else:
                    runs.append([left])
            longest = max(runs, key=len)
            place = longest[len(longest) // 2 if longest[0] - 1 in self._last.values() else 0]
        self._last[worker] = place
        self._left.remove(place)
        return self._numbers[place]

    def put_back(self, number: int) -> None:
        """Take back a frame that a worker was given."""
        self._left.add(self._numbers.index(number))


class _Outputs:
    """The outputs of a batch that are left, and which worker makes each of the others.

    Each is given to one worker and no other, and taken back when that one ends. So it is known at which output a worker
    ended, which the scheduler does not tell of workers that it has given several: the first of those that it had.
    """

    def __init__(
        self, client: Client, kept: str, before: Mapping[int, Stamp], names: Sequence[str], console: Console
    ) -> None:
        """Take which outputs there are to make, and what was in their places before."""
        self._client, self._kept, self._before, self._names, self._console = client, kept, before, names, console
        self._left = Runs(list(before))
        self._running: dict[Future, tuple[int, str]] = {}
        self._some_done = threading.Event()
        self._claimed: list[int] = []
        # How many workers have ended at each output.
        self._ends: Counter[int] = Counter()

    def as_done(self, deadline: Deadline) -> Iterator[tuple[int, Reply]]:
        """Yield outputs as they are done."""
        while self._running or ((self._left or self._claimed) and deadline.leaves_time()):
            try:
                workers = set(self._client.nthreads())
            except OSError as error:
                raise StoppedEarlyError(SCHEDULER_ENDED) from error
            # What was given to workers that have ended is taken back.
            for worker in {worker for _, worker in self._running.values()} - workers:
                at_work, *waiting = [future for future, given in self._running.items() if given[1] == worker]
                for future in waiting:
                    if not future.done():
                        self._left.put_back(self._let_go(future)[0])
                if not at_work.done():
                    self._worker_ended(at_work)
            if deadline.leaves_time():
                if not self._left and not self._running:
                    # What another command was making may be left by it.
                    time.sleep(SECONDS_BETWEEN_LOOKS)
                    self._left, self._claimed = Runs(self._claimed), []
                at_work_on = Counter(worker for _, worker in self._running.values())
                for worker in sorted(worker for worker in workers if not at_work_on[worker]):
                    self._give(worker)
                # One to go on with; the last outputs are kept for whoever is done first.
                for worker in sorted(worker for worker in workers if at_work_on[worker] < 2):
                    if len(self._left) > len(workers) and deadline.leaves_time(2):
                        self._give(worker)
            for number, reply in self._done():
                if reply.made is Turn.CLAIMED:
                    self._claimed.append(number)
                else:
                    yield number, reply
        for number, ends in self._ends.items():
            if ends >= WORKERS_GIVEN_UP:
                text = f"{self._names[number]}: {ends} workers ended while they worked on it"
                yield number, Reply(InputError(text))

    def cancel(self) -> None:
        """Give up what is still being made."""
        if self._running:
            with contextlib.suppress(OSError):
                self._client.cancel(list(self._running), force=True)

    def _give(self, worker: str) -> None:
        """Give a worker an output, if there is one left."""
        if self._left:
            number = self._left.next_for(worker)
            future = self._client.submit(_make, self._kept, number, self._before[number], workers=[worker], pure=False)
            self._running[future] = number, worker
            future.add_done_callback(lambda _future: self._some_done.set())

    def _let_go(self, future: Future) -> tuple[int, str]:
        """Ask no longer for an output; return its number and its worker."""
        self._client.cancel([future], force=True)
        return self._running.pop(future)

    def _worker_ended(self, future: Future) -> None:
        """Leave an output to another worker than the one that ended at it, or give it up after some."""
        number, worker = self._let_go(future)
        self._ends[number] += 1
        if self._ends[number] < WORKERS_GIVEN_UP:
            text = f"the worker {worker} ended while it worked on it, which goes to another"
            self._console.warn([Notice("worker-ended", self._names[number], text, "memory, or its time limit")])
            self._left.put_back(number)

    def _done(self) -> Iterator[tuple[int, Reply]]:
        """Yield what is done, after a while at the latest."""
        self._some_done.wait(LOOK_S)
        self._some_done.clear()
        for future in [future for future in self._running if future.done()]:
            try:
                reply = future.result(timeout=CONNECT_S)
            except (KilledWorker, TimeoutError):  # it ended after it was done, and before it could tell
                self._worker_ended(future)
            except CancelledError as error:
                raise StoppedEarlyError(SCHEDULER_ENDED) from error
            else:
                yield self._running.pop(future)[0], reply
