"""Returns as text: the one way in which a terminal shows them."""

import math

WHOLE = 999.95  # from here on four digits are a whole number
LEAST = 1e-4  # what is smaller is written with an exponent


def return_text(mean: float, deviation: float | None = None) -> str:
    """A return: whole where it is large, else four digits of it; with its ``deviation``, both to the same decimals."""
    larger = max(abs(mean), abs(deviation or 0.0))
    form = "z,.0f" if larger >= WHOLE else "z,.4g"
    if deviation is None:
        return format(mean, form)
    if LEAST <= larger < WHOLE:
        form = f"z,.{3 - math.floor(math.log10(larger))}f"
    return f"{mean:{form}} ± {deviation:{form}}"
