from __future__ import annotations

import base64

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.trackers.adapters.trax_worker import (
    Message,
    ProtocolError,
    join_message,
    read_memory_image,
    read_region,
    split_message,
    write_rectangle,
)

words = st.text(st.characters(exclude_categories=["Cs"]), min_size=1).filter(lambda text: "=" not in text)
keys = st.text("abcXYZ019._", min_size=1, max_size=64)


@given(st.lists(words), st.dictionaries(keys, st.text(st.characters(exclude_categories=["Cs"]))))
def test_messages_survive_the_wire(arguments: list[str], properties: dict[str, str]) -> None:
    line = join_message("state", arguments, properties)
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    assert split_message(line) == Message("state", arguments, properties)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        # as the reference library writes them
        (
            b'@@TRAX:hello "foo=bar baz" "trax.name=ncc \\"x\\"" "trax.image=path;url;memory;" "trax.version=4" \n',
            Message(
                "hello",
                [],
                {
                    "foo": "bar baz",
                    "trax.name": 'ncc "x"',
                    "trax.image": "path;url;memory;",
                    "trax.version": "4",
                },
            ),
        ),
        (b"@@TRAX:quit \n", Message("quit", [], {})),
        (b"@@TRAX:initialize\r\n", Message("initialize", [], {})),
        (b"@@TRAX:initialize 1,2,3,4\n", Message("initialize", ["1,2,3,4"], {})),
        (b'@@TRAX:frame "file:///a b.jpg" "seq=s 1"\n', Message("frame", ["file:///a b.jpg"], {"seq": "s 1"})),
        # an address is no property, whatever it holds
        (b"@@TRAX:frame http://x/a?b=c\n", Message("frame", ["http://x/a?b=c"], {})),
        (b"@@TRAX:frame file://c:\\new\\a.jpg\n", Message("frame", ["file://c:\\new\\a.jpg"], {})),
        (b"50 % done @@TRAX:state 1,2,3,4\n", Message("state", ["1,2,3,4"], {})),
        (b"@@TRAX:state 1,2,3,4 \xff\xfe\n", Message("state", ["1,2,3,4", "\udcff\udcfe"], {})),
        (b"just output\n", None),
        (b"\n", None),
    ],
)
def test_lines_of_others(line: bytes, message: Message | None) -> None:
    assert split_message(line) == message


@pytest.mark.parametrize("line", [b"@@TRAX:\n", b"@@TRAX: state\n", b"@@TRAX:7 1,2\n"])
def test_a_message_without_a_name_is_refused(line: bytes) -> None:
    with pytest.raises(ProtocolError, match="has no name"):
        split_message(line)


@given(st.lists(st.floats(0, 1e6), min_size=4, max_size=4))
def test_rectangles_keep_every_digit(box: list[float]) -> None:
    assert read_region(write_rectangle(box)) == tuple(box)


@pytest.mark.parametrize(
    ("text", "box"),
    [
        ("1,2,3,4", (1, 2, 3, 4)),
        (" 1, 2, 3, 4 ", (1, 2, 3, 4)),
        ("-1.5,2e1,3,4", (-1.5, 20, 3, 4)),
        ("0,0,4,0,4,3,0,3", (0, 0, 4, 3)),
        ("mask:5,6,4,3,5,2,2,2,1", (6, 7, 2, 2)),
        ("0", None),
        ("-7", None),
    ],
)
def test_regions(text: str, box: tuple[float, ...] | None) -> None:
    assert read_region(text) == box


@pytest.mark.parametrize(
    "text",
    ["", "a,b", "1,2", "1,2,3", "1,2,3,4,5", "1,2,3,4,5,6,7", "1,2,inf,4", "1,2,nan,4", "1,2,3,-4", "mask:", "mask:1,2",
     "mask:0,0,2,2,4", "mask:0,0,2,2,1,9", "mask:0,0,-2,2,1,1", "mask:0,0,100000,100000,1,1", "mask:0,0,2,2,1,-1"],
)  # fmt: skip
def test_regions_that_are_none(text: str) -> None:
    with pytest.raises(ProtocolError):
        read_region(text)


def test_memory_images() -> None:
    pixels = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    # as the reference library writes it
    assert (read_memory_image("image:3;2;rgb;AAECAwQFBgcICQoLDA0ODxAR") == pixels).all()
    grey = read_memory_image("image:3;2;gray8;AAMGCQwP")
    assert grey.shape == (2, 3, 3) and (grey[..., 1] == pixels[..., 0]).all()
    # 1, 258, 515, ...: the lower byte first
    deep = read_memory_image("image:3;2;gray16;AQACAQMCBAMFBAYF")
    assert (deep[..., 0] == [[0, 1, 2], [3, 4, 5]]).all()


@pytest.mark.parametrize(
    "text",
    ["file:///a.jpg", "image:", "image:3;2;rgb", "image:3;2;cmyk;AAAA", "image:3;2;rgb;AAAA", "image:a;2;rgb;AAAA",
     "image:-1;2;rgb;" + base64.b64encode(bytes(6)).decode(), "image:3;2;rgb;!!!"],
)  # fmt: skip
def test_memory_images_that_are_none(text: str) -> None:
    with pytest.raises(ProtocolError):
        read_memory_image(text)
