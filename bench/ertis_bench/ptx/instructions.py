"""Analysis of a kernel's machine code: the executed path, its loops, and their instructions by kind."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Instruction", "kinds", "loops", "parse", "way"]

_LINE = re.compile(r"/\*[0-9a-f]{4,}\*/\s+(?P<predicate>@!?U?P\w+\s+)?(?P<name>[A-Z][\w.]*)(?P<rest>[^;]*);")
_LABEL = re.compile(r"^(?P<label>[.$\w]+):")
_TARGET = re.compile(r"`\((?P<label>[^)]+)\)")
_INTEGER = ("I", "UI", "LEA", "ULEA", "LOP", "ULOP", "SHF", "USHF", "PRMT", "UPRMT", "SEL", "USEL", "BMSK", "VI")
_MULTIPLY_ADD = ("FFMA", "FMUL", "FADD")
_ENDS = {"EXIT", "BRA", "RET.REL.NODEC"}
_CALL_COST = 10_000  # Number of loads that outweighs a call, so that paths with calls are avoided.


@dataclass(frozen=True, slots=True)
class Instruction:
    """Instruction of a warp.

    Attributes
    ----------
    name : str
        Name such as ``FFMA`` or ``LDG.E.64``.
    conditional : bool
    target : int
        Target of a branch within the kernel, as an index of instructions; -1 for other instructions.
    """

    name: str
    conditional: bool
    target: int


def parse(text: str) -> list[Instruction]:
    """Return the instructions in nvdisasm's text."""
    found: list[tuple[str, bool, str]] = []
    places: dict[str, int] = {}
    for line in text.splitlines():
        if label := _LABEL.match(line):
            places[label["label"]] = len(found)
        elif match := _LINE.search(line):
            branch = match["name"].startswith("BRA") and _TARGET.search(match["rest"])
            found.append((match["name"], match["predicate"] is not None, branch["label"] if branch else ""))
    return [Instruction(name, conditional, places.get(label, -1)) for name, conditional, label in found]


def way(code: Sequence[Instruction]) -> list[int]:
    """Return the indices of the instructions that a warp executes if it runs once through every loop.

    At a branch, the path with more loads, multiplications and additions is taken. Threads with a full share of the work
    follow this path. Paths with function calls are avoided, because functions only handle rare operands, such as roots
    of numbers near the limits of float32.
    """
    worth, ahead = [0] * len(code), [-1] * len(code)
    for at in reversed(range(len(code))):
        here = code[at]
        followers = [] if here.name in _ENDS and not here.conditional else [at + 1]
        if here.target >= 0:
            followers = [here.target, *followers]
        followers = [place for place in followers if at < place < len(code)]
        worth[at] = -_CALL_COST if here.name.startswith("CALL") else int(_kind(here.name) in {"loads", "multiply-adds"})
        if followers:
            ahead[at] = max(followers, key=worth.__getitem__)
            worth[at] += worth[ahead[at]]
    met = [0]
    while ahead[met[-1]] >= 0:
        met.append(ahead[met[-1]])
    return met


def loops(code: Sequence[Instruction]) -> list[range]:
    """Return the innermost loops on the `way`, as ranges of indices, in their order."""
    met = set(way(code))
    found = [range(each.target, at + 1) for at, each in enumerate(code) if at in met and -1 < each.target < at]
    return [one for one in found if not any(_within(other, one) for other in found)]


def _within(inner: range, outer: range) -> bool:
    return inner != outer and inner[0] in outer and inner[-1] in outer


def kinds(part: Sequence[Instruction]) -> dict[str, int]:
    """Return the numbers of loads, float multiplications and additions, integer instructions, and others."""
    counts = Counter(_kind(each.name) for each in part)
    return {name: counts[name] for name in ("loads", "multiply-adds", "integer", "others")}


def _kind(name: str) -> str:
    if name.startswith("LDG"):
        return "loads"
    if name.startswith(_MULTIPLY_ADD):
        return "multiply-adds"
    return "integer" if name.startswith(_INTEGER) else "others"
