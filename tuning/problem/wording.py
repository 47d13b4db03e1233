"""How numbers are put into sentences; any module of `tuning` may import it."""

from collections.abc import Sequence


def count(number: int, thing: str) -> str:
    """Return a number with its noun in the singular or the plural."""
    plural = f"{thing}es" if thing.endswith(("s", "ch", "sh", "x")) else f"{thing}s"
    return f"{number} {thing if number == 1 else plural}"


def numbered(word: str, numbers: Sequence[int]) -> str:
    """Return "tank 3", "tanks 1, 3" or "tanks 1 to 4"."""
    if len(numbers) == 1:
        return f"{word} {numbers[0]}"
    if len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return f"{word}s {numbers[0]} to {numbers[-1]}"
    return f"{word}s {', '.join(map(str, numbers))}"
