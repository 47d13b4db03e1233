"""Results of evaluations, kept in memory or in a file that a killed run continues from."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tuning.storage.fingerprint import digest
from tuning.storage.store import Folder, Store


class EvaluationCache:
    """Results by what was evaluated."""

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
            self.found[key] = self.keep(key, result)

    def keep(self, key: str, result: Any) -> Any:
        """Return `result`, entered wherever it is to be kept."""
        return result

    def close(self) -> None:
        """Write nothing more."""


class EvaluationLog(EvaluationCache):
    """An EvaluationCache whose results are records of a Store, too."""

    def __init__(self, folder: Folder, problem: Mapping[str, Any], resume: bool = False):
        super().__init__()
        self.store = Store(folder, problem, resume=resume, afresh=True)
        self.found = {key: self.store.get(key) for key in self.store.finished()}

    def keep(self, key: str, result: Any) -> Any:
        """Return the value that is read back from the record of `result`."""
        return self.store.put(key, tuple(result))

    def close(self) -> None:
        self.store.close()
