def describe_skips(skipped: list[tuple[int, int]], place: int, end: int) -> list[str]:
    """Remarks on damaged blocks (first byte, byte after the last) and on a file that ends early."""
    remarks = []
    if skipped:
        lost = sum(after - before for before, after in skipped)
        first = ", ".join(f"{before} .. {after - 1}" for before, after in skipped[:4])
        more = ", ..." if len(skipped) > 4 else ""
        blocks = "damaged block" if len(skipped) == 1 else "damaged blocks"
        remarks.append(f"{len(skipped)} {blocks}, {lost} bytes, skipped: bytes {first}{more}")
    if place < end:
        remarks.append(
            f"the file is cut off: {end - place} bytes from byte {place} on make no message"
        )
    return remarks
