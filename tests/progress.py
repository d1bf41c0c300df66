"""Messages of a command without its lines of progress, which a busy machine prints after some seconds."""


def without_progress(said: bytes | str) -> list[str]:
    """Return the lines on standard error except those that only say that machine code is loaded."""
    text = said.decode(errors="replace") if isinstance(said, bytes) else said
    return [line for line in text.strip().splitlines() if not line.endswith("loading machine code")]
