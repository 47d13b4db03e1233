"""Results of evaluations, kept in memory or in a file that a killed run continues from."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tuning.storage.fingerprint import digest
from tuning.storage.store import Folder, Store


class EvaluationCache:
    """Results by what was evaluated; those of an EvaluationLog are records of a Store, too."""

    store: Store | None = None

    def __init__(self):
        self.found: dict[str, Any] = {}

    def recall(self, kind: str, arguments: Sequence[Any], compute: Callable[[], Any]) -> Any:
        """Return compute(), or what it gave for the same kind and arguments (arrays, numbers)."""
        key = digest(kind, *arguments)
        if key not in self.found:
            self.enter(key, compute())
        return self.found[key]

    def enter(self, key: str, result: Any) -> None:
        if key not in self.found:
            self.found[key] = result if self.store is None else self.store.put(key, tuple(result))

    def close(self) -> None:
        if self.store is not None:
            self.store.close()


class EvaluationLog(EvaluationCache):
    def __init__(self, folder: Folder, problem: Mapping[str, Any], resume: bool = False):
        self.store = Store(folder, problem, resume=resume, afresh=True)
        self.found = {key: self.store.get(key) for key in self.store.finished()}
