"""One task a bag, by whatever executor; what went wrong with a bag is an answer, not an end."""

from collections import deque
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from bags.fleet.manifest import Manifest, key_of
from bags.fleet.workers import Workers
from bags.recordings.remote import RemotePath
from nlsid_core.errors import BagError, DataError
from nlsid_core.progress import Progress, silent


class Task(Protocol):
    """What is asked of every bag; it travels to the workers."""

    @property
    def asked(self) -> str:
        """What is asked, as text: another text is another question."""

    def __call__(self, bag: Path, name: str) -> bytes:
        """The answer, some kilobytes. Whatever it raises is the reason why there is none."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer for one bag: content, or the reason why there is none.

    kept: it was in the manifest.
    """

    bag: Path
    name: str
    content: bytes = b""
    reason: str = ""
    kept: bool = False


def ask(
    task: Task,
    bags: Mapping[str, Path],
    workers: Workers,
    manifest: Manifest,
    *,
    progress: Progress = silent,
) -> Iterator[Answer]:
    """The answers in the order of `bags` (by name), whoever gave them and whenever they came.

    All are there before the first is given. Until then the manifest holds what they say, so that
    memory does not.

    Bags that were read when a worker died are asked of again, each alone: another of them may have
    been the cause. One is given up when its worker dies twice then. Raises DataError if the workers
    are gone for good; what was answered by then is in the manifest.
    """
    answers: dict[str, Answer] = {}
    asked: dict[str, tuple[Path, str]] = {}
    keys: dict[str, str] = {}
    for name, bag in bags.items():
        try:
            keys[name] = key_of(bag, name, task.asked)
        except (OSError, BagError) as error:
            answers[name] = Answer(bag, name, reason=_said(error, bag, name))
            continue
        if keys[name] in manifest:
            answers[name] = Answer(bag, name, kept=True)
        else:
            asked[name] = bag, keys[name]
    if known := sum(answer.kept for answer in answers.values()):
        progress(f"{known} of {len(bags)} bags are known", len(answers) / len(bags))
    with closing(_asked(task, asked, workers)) as given:
        for answer in given:
            if not answer.reason:
                manifest.keep(keys[answer.name], str(answer.bag), answer.content)
            answers[answer.name] = replace(answer, bag=bags[answer.name], content=b"")
            progress(f"{len(answers)} of {len(bags)} bags: {answer.name}", len(answers) / len(bags))
    for name in bags:
        answer = answers.pop(name)
        yield answer if answer.reason else replace(answer, content=manifest.find(keys.pop(name)))


def _asked(
    task: Task, bags: Mapping[str, tuple[Path, str]], workers: Workers
) -> Generator[Answer, None, None]:
    """An answer for each bag (where it is, its key), as they come.

    Those that were read when a worker died are asked of again, each alone, at most twice.
    """
    died: list[str] = []
    if bags:
        yield from _answers(task, bags, workers, died)
    for _ in range(2):
        asked, died = died, []
        for name in asked:
            yield from _answers(task, {name: bags[name]}, workers, died)
    for name in died:
        yield Answer(bags[name][0], name, reason="its worker died twice")


def _answers(
    task: Task, bags: Mapping[str, tuple[Path, str]], workers: Workers, died: list[str]
) -> Generator[Answer, None, None]:
    """The same; died: gets the bags that were read when a worker died."""
    waiting = deque(bags)
    executor = workers.open()
    running: dict[Future[Answer], str] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers.window:
                name = waiting.popleft()
                running[_submitted(executor, task, *bags[name], name)] = name
                if next(reversed(running)).done():
                    break  # in this process: said at once
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            before = len(died)
            for future in done:
                name = running.pop(future)
                error = _error(future)
                if error is None:
                    yield future.result()
                elif isinstance(error, BrokenExecutor):
                    died.append(name)
                else:
                    yield Answer(bags[name][0], name, reason=_said(error, bags[name][0], name))
            if len(died) > before:
                died += running.values()
                running.clear()
                workers.close(executor)
                executor = workers.open()
    finally:
        workers.close(executor)


def _submitted(executor: Executor, task: Task, bag: Path, key: str, name: str) -> "Future[Answer]":
    try:
        return executor.submit(answered, task, bag, key, name)
    except BrokenExecutor as error:  # a worker has died since the last look
        failed: Future[Answer] = Future()
        failed.set_exception(error)
        return failed


def answered(task: Task, bag: Path, key: str, name: str) -> Answer:
    """What a worker does: the task, with whatever it raises as the reason.

    key: of the bag as it was listed. If it is another afterwards there is no answer: ranges of two
    files would be taken for one recording.
    """
    content, reason = b"", ""
    again = bag.anew() if isinstance(bag, RemotePath) else bag
    try:
        content = task(bag, name)
        if key_of(again, name, task.asked) != key:
            content, reason = b"", "it changed while it was read; start the command again"
    except Exception as error:  # bags are untrusted: whatever one of them causes is about it alone
        reason = _said(error, bag, name)
    if isinstance(bag, RemotePath):
        bag.forget()
    return Answer(bag, name, content, reason)


def _error(future: "Future[Answer]") -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        raise DataError(
            "the scheduler has lost its tasks; start it and this command again: what was read by "
            "now is kept"
        ) from error


def _said(error: BaseException, bag: Path, name: str) -> str:
    """What is said of a bag beside its name, so without it."""
    if isinstance(error, FileNotFoundError):
        return "it is not there any more"
    text = without_name(str(error), bag, name)[:500]
    return text if isinstance(error, (DataError, OSError)) else f"{type(error).__name__}: {text}"


def without_name(text: str, bag: Path, name: str) -> str:
    """An error's text less the bag's name at its beginning."""
    for called in (str(bag), name):
        text = text.removeprefix(f"{called}: ").removeprefix(f"{called} ")
    return text
