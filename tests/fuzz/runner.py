"""Runs cases in processes of their own. A process that dies or exceeds a budget ends with its case; another one goes on."""

from __future__ import annotations

import json
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from .kinds import KINDS, Case
from .outcome import FAULT, Outcome

#: Cases of a process.
BATCH = 400
# Seconds for the start of a process; seconds between two looks at a case.
_START, _LOOK = 180.0, 0.1
_ROOT = Path(__file__).parents[2]

Report = Callable[[Case, Outcome], None]


def run_cases(
    cases: Sequence[Case],
    on_done: Report,
    on_wait: Callable[[], None] = lambda: None,
    on_end: Callable[[str], None] | None = None,
) -> None:
    """Try all cases in order.

    Args:
        cases: any.
        on_done: called with each case and its outcome.
        on_wait: called several times a second.
        on_end: called with the standard error of each process.
    """
    left = list(cases)
    while left:
        with tempfile.TemporaryFile() as said:
            done = _run_batch(left[:BATCH], said, on_done, on_wait)
            if on_end is not None:
                on_end(_text(said))
        left = left[done:]


def _run_batch(batch: Sequence[Case], said: IO[bytes], on_done: Report, on_wait: Callable[[], None]) -> int:
    """Try cases in one process, which writes its standard error into ``said``. Returns how many have ended."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, _process(batch, said, folder) as (process, lines):
        done, begun, deadline, base = 0, False, time.monotonic() + _START, 0.0
        while True:
            on_wait()
            case = batch[min(done, len(batch) - 1)]
            kind = KINDS[case.kind]
            try:
                line = lines.get(timeout=_LOOK)
            except queue.Empty:
                grown = _megabytes(process.pid) - base
                if time.monotonic() > deadline:
                    reason = f"no end after {kind.seconds:.0f} s" if begun else "the process did not start"
                    _end(process)
                elif begun and grown > kind.megabytes:
                    reason = f"memory grew by {grown:.0f} MB"
                    _end(process)
                else:
                    continue
                on_done(case, Outcome(FAULT, f"{reason} ({_stack(said)})"))
                return done + 1
            if line is None:
                process.wait()
                if done < len(batch):
                    on_done(case, Outcome(FAULT, f"the process ended: {_status(process.returncode)} ({_stack(said)})"))
                return min(done + 1, len(batch))
            if "begin" in line:
                begun, deadline, base = True, time.monotonic() + kind.seconds, _megabytes(process.pid)
            elif "case" in line:
                outcome = Outcome(line["outcome"], line["text"], line["seconds"])
                if line["megabytes"] > kind.megabytes:
                    outcome = Outcome(FAULT, f"memory grew by {line['megabytes']} MB: {outcome.kind}: {outcome.text}")
                on_done(case, outcome)
                done, begun = done + 1, False
                deadline = time.monotonic() + _START
            elif "end" in line:
                return len(batch)


@contextmanager
def _process(batch: Sequence[Case], said: IO[bytes], folder: str) -> Iterator[tuple[subprocess.Popen[bytes], queue.Queue[Any]]]:
    """A process with its temporary files in a folder, and the lines that it writes; None after the last one."""
    code = [sys.executable, "-m", f"{__package__}.worker"]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": _python_path(),
        "TMPDIR": folder,
    }
    process = subprocess.Popen(
        code, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, cwd=_ROOT, env=environment, start_new_session=True
    )
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps([(case.kind, case.number, case.seed) for case in batch]).encode())
    process.stdin.close()
    lines: queue.Queue[Any] = queue.Queue()
    reader = threading.Thread(target=_read, args=(process.stdout, lines), daemon=True)
    reader.start()
    try:
        yield process, lines
    finally:
        _end(process)
        process.stdout.close()


def _read(stream: IO[bytes], lines: queue.Queue[Any]) -> None:
    try:
        for line in stream:
            lines.put(json.loads(line))
    except ValueError:
        pass  # the end of a process that was killed
    lines.put(None)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process, after it has written where it is."""
    if process.poll() is not None:
        return
    if hasattr(signal, "SIGUSR1"):
        process.send_signal(signal.SIGUSR1)
        time.sleep(0.2)
    try:
        os.killpg(process.pid, signal.SIGKILL)  # also the processes that it has started
    except (ProcessLookupError, PermissionError):
        process.kill()
    process.wait()


def _python_path() -> str:
    return os.pathsep.join([str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])


def _megabytes(process: int) -> float:
    """Memory of a process, 0 where the system does not tell."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _status(code: int) -> str:
    return f"signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"exit status {code}"


def _stack(said: IO[bytes]) -> str:
    """The last words of a process that was ended: a failure of Dr.Jit, and the innermost frames of this package."""
    text = _text(said)
    frames = re.findall(
        r'File ".*?(shadowmap_dr/[^"]*|tests/fuzz/[^"]*)", line (\d+)', text[text.rfind("most recent call first") :]
    )
    failures = re.findall(r"^.*(?:[Ff]ailure|terminate called|what\(\):).*$", text[-20_000:], re.MULTILINE)
    words = [line.strip() for line in failures[-1:]] + [f"{path}:{line}" for path, line in frames[:2]]
    return ", ".join(words) or " ".join(text.split())[-200:] or "it has said nothing"


def _text(said: IO[bytes]) -> str:
    said.seek(0)
    return said.read().decode("utf-8", "replace")
