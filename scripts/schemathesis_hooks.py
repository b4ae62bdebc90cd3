"""Archives, parts of them and JSONL for Schemathesis: it makes up the bytes, which the server must refuse politely."""

import schemathesis


@schemathesis.serializer("application/zip", "application/x-tar", "application/zstd", "application/jsonl", "application/offset+octet-stream")
def as_it_is(_context, value):
    return value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
