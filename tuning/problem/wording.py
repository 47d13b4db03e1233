"""How numbers are put into sentences; any module of `tuning` may import it."""


def count(number: int, thing: str) -> str:
    """Return a number with its noun in the singular or the plural.

    Examples
    --------
    >>> count(1, "run"), count(0, "run"), count(3, "search")
    ('1 run', '0 runs', '3 searches')
    """
    plural = f"{thing}es" if thing.endswith(("s", "ch", "sh", "x")) else f"{thing}s"
    return f"{number} {thing if number == 1 else plural}"
