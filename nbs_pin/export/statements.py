"""Symbols as statements of C."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

from nbs_pin.export.reals import LIBM, Real
from nbs_pin.export.symbols import Call, Number, Remark, Symbol, Tape

Outputs: TypeAlias = Mapping[str, Sequence[Number]]
_LONGEST = 90
"""Characters above which an expression gets a variable of its own."""
_SUM, _PRODUCT, _ATOM = range(3)
"""How strongly the parts of a text hold together."""


class _Text(NamedTuple):
    text: str
    strength: int

    def within(self, strength: int) -> str:
        """The text as an operand that must hold together at least so strongly."""
        return self.text if self.strength >= strength else f"({self.text})"


def statements(tape: Tape, outputs: Outputs, real: Real) -> str:
    """The operations that the arrays in `outputs` need, in order, and the assignments to these."""
    writer, lines, remark = _Writer(_uses(tape, outputs), real), [], ""
    for entry in tape.entries:
        if isinstance(entry, Remark):
            remark = entry.text
            continue
        written = list(writer.call(entry) if isinstance(entry, Call) else writer.definition(entry))
        if written and remark:
            lines += ["", f"/* {remark} */"]
            remark = ""
        lines += written
    lines.append("")
    lines += [f"{name}[{i}] = {writer.of(x).text};" for name, array in outputs.items() for i, x in enumerate(array)]
    return "\n".join(f"    {line}".rstrip() for line in lines)


def _uses(tape: Tape, outputs: Outputs) -> Counter[int]:
    """How often each symbol that anything depends on is used, by its place."""
    calls = [entry.inputs for entry in tape.entries if isinstance(entry, Call)]
    pending = [x for arrays in (outputs, *calls) for array in arrays.values() for x in array if isinstance(x, Symbol)]
    uses: Counter[int] = Counter()
    while pending:
        x = pending.pop()
        uses[x.place] += 1
        if uses[x.place] == 1:
            pending += [y for y in x.arguments if isinstance(y, Symbol)]
    return uses


class _Writer:
    """Writes symbols: short ones that are used once in place, others by the name of a variable."""

    def __init__(self, uses: Counter[int], real: Real) -> None:
        self.uses, self.real = uses, real
        self._written: dict[int, _Text] = {}

    def definition(self, x: Symbol) -> Iterator[str]:
        """The definition of a variable, if x is needed and gets one."""
        uses = self.uses[x.place]
        if uses == 0:
            return
        text = self._expression(x)
        if (uses > 1 and x.operation not in ("leaf", "negative")) or len(text.text) > _LONGEST:
            yield f"const real t{x.place} = {text.text};"
            text = _Text(f"t{x.place}", _ATOM)
        self._written[x.place] = text

    def call(self, call: Call) -> Iterator[str]:
        """The arrays of a call, and the call."""
        for name, values in call.inputs.items():
            yield f"const real {name}[{len(values)}] = {{{', '.join(self.of(x).text for x in values)}}};"
        for name, count in call.outputs.items():
            yield f"real {name}[{count}];"
        yield f"{call.function}({', '.join([*call.inputs, *call.outputs])});"

    def of(self, x: Number) -> _Text:
        """An operand."""
        if isinstance(x, Symbol):
            return self._written[x.place]
        return _Text(self.real.literal(x), _SUM if x < 0.0 else _ATOM)

    def _expression(self, x: Symbol) -> _Text:
        if x.operation == "leaf":
            return _Text(x.arguments[0], _ATOM)
        operands = [self.of(y) for y in x.arguments]
        if x.operation == "negative":
            return _Text(f"-{operands[0].within(_PRODUCT)}", _SUM)
        if len(operands) == 1:
            function = self.real.function(x.operation) if x.operation in LIBM else x.operation
            return _Text(f"{function}({operands[0].text})", _ATOM)
        strength = _SUM if x.operation in "+-" else _PRODUCT
        # C reads from the left: an operand on the right must hold together more strongly to keep the order.
        left, right = operands[0].within(strength), operands[1].within(strength + 1)
        return _Text(f"{left} {x.operation} {right}", strength)
