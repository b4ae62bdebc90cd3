"""Marks archives, parts of them and JSONL for Schemathesis as arbitrary bytes, which the server must refuse with a problem."""

import schemathesis


@schemathesis.serializer("application/zip", "application/x-tar", "application/zstd", "application/jsonl", "application/offset+octet-stream")
def as_it_is(_context, value):
    return value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
