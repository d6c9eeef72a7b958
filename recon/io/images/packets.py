"""Frames of H.264 and H.265 (ITU-T, 7.3.1, annex B) in messages, decoded by PyAV."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Final

from recon.core.errors import FormatError, require
from recon.core.values.arrays import UInt8

#: By codec: a packet with this unit, which describes the frames that follow, can be begun with.
_DELAY: Final = 16  # packets after which a decoder has given a frame, or never will
BEGINS: Final = {
    "h264": re.compile(rb"\x00\x00\x01[\x07\x27\x47\x67]"),
    "hevc": re.compile(rb"\x00\x00\x01[\x42\x43]"),
}


def codec_of(form: str) -> str | None:
    """Return the codec by the format or encoding of a message; None = of single images."""
    name = form.lower().replace("265", "hevc").replace("264", "h264")
    return next((codec for codec in BEGINS if codec in name), None)


def decode_packets(
    packets: Iterable[tuple[int, bytes]], wanted: Sequence[int], codec: str, where: str
) -> Iterator[UInt8]:
    """Decode packets and yield the frames of some of their increasing numbers, RGB (H, W, 3)."""
    av, done, got = require("av", extra="video"), 0, "no frame"
    context = av.CodecContext.create(codec, "r")
    context.thread_count, context.options = 1, {"err_detect": "explode", "flags": "+low_delay"}
    try:
        for number, content in chain(packets, [(wanted[-1], b"")]):  # at last what it still has
            packet = av.Packet(content)
            packet.pts = number
            for frame in context.decode(packet if content else None):
                if frame.pts == wanted[done] and not frame.is_corrupt:
                    yield frame.to_ndarray(format="rgb24")
                    done += 1
                    if done == len(wanted):
                        return
            if number > wanted[done] + _DELAY:
                break
    except av.FFmpegError as error:
        got = error.strerror
    what, hint = "frame of a video cannot be decoded", "copy the recording again, or end before it"
    raise FormatError(what, where=f"{where}, message {wanted[done]}", got=got, hint=hint)
