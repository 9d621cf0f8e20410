"""What is shown to a terminal."""

from __future__ import annotations

import io

from hiersched.core.faults import PrintableStream


def test_what_a_terminal_would_act_on_or_cannot_show_is_escaped():
    data = io.BytesIO()
    stream = PrintableStream(io.TextIOWrapper(data, encoding="ascii", write_through=True))
    print("K\u00f6rper \x1b[2J \u2192 \udc80", file=stream)  # a surrogate: of a file's name
    assert data.getvalue() == b"K\\xf6rper \\x1b[2J \\u2192 \\udc80\n"


def test_text_without_an_encoding_stays():
    shown = io.StringIO()
    PrintableStream(shown).write("K\u00f6rper\n")
    assert shown.getvalue() == "K\u00f6rper\n"
