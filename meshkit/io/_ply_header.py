"""Header of a PLY file: the order of its bytes, and what its elements are made of."""

from typing import BinaryIO, NamedTuple

from meshkit.io._lines import EMPTY, TOO_EARLY, blame, shown

_TYPES = {
    **{b"char": "i1", b"uchar": "u1", b"short": "i2", b"ushort": "u2", b"int": "i4", b"uint": "u4"},
    **{b"int8": "i1", b"uint8": "u1", b"int16": "i2", b"uint16": "u2", b"int32": "i4", b"uint32": "u4"},
    **{b"float": "f4", b"double": "f8", b"float32": "f4", b"float64": "f8"},
}
_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_LONGEST = 2**16  # bytes of a line of the header
_MOST_LINES = 10_000


class Property(NamedTuple):
    name: str
    kind: str
    size: str = ""  # type of the number of entries of a list


class Element(NamedTuple):
    name: str
    rows: int
    properties: list[Property]

    @property
    def lists(self) -> bool:
        return any(p.size for p in self.properties)


def read_header(stream: BinaryIO) -> tuple[str, list[Element], int]:
    """Byte order (empty for text), elements, and the number of lines."""
    first = stream.readline(_LONGEST)
    if not first:
        raise ValueError(EMPTY)
    if first.strip() != b"ply":
        raise ValueError(f"the first line is {shown(first)}, not ply")
    order: str | None = None
    elements: list[Element] = []
    for number in range(2, _MOST_LINES):
        line = stream.readline(_LONGEST)
        if not line.endswith(b"\n"):
            raise ValueError(f"{TOO_EARLY}: there is no end_header")
        match line.split():
            case [b"end_header"]:
                if order is None:
                    raise ValueError("its header has no line of the format")
                return order, elements, number
            case [b"format", kind, b"1.0"] if kind in _ORDERS and order is None:
                order = _ORDERS[kind]
            case [b"element", name, count] if count.isdigit():
                elements.append(Element(name.decode(errors="replace"), int(count), []))
            case [b"property", b"list", size, kind, name] if elements and _TYPES.get(size, "f")[0] in "iu":
                _add(elements[-1], number, line, name, kind, _TYPES[size])
            case [b"property", kind, name] if elements:
                _add(elements[-1], number, line, name, kind)
            case [b"comment" | b"obj_info", *_] | []:
                pass
            case _:
                raise blame(number, line, "no line of the header of a PLY file")
    raise ValueError(f"there is no end_header in its first {_MOST_LINES:,} lines")


def _add(element: Element, number: int, line: bytes, name: bytes, kind: bytes, size: str = "") -> None:
    text = name.decode(errors="replace")
    if kind not in _TYPES:
        raise blame(number, line, f"{shown(kind)} is no type of a PLY file")
    if any(p.name == text for p in element.properties):
        raise blame(number, line, f"{element.name} has two properties of this name")
    element.properties.append(Property(text, _TYPES[kind], size))
