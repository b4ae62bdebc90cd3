"""A scripted chat model with OpenAI's protocol. Its reply depends only on the prompt, and it records every call."""
import json
import re
import threading
import time
import zlib
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

PROMPT_USD, COMPLETION_USD = 2.0, 8.0
CANDIDATE = re.compile(r"^ID (\d+): score", re.MULTILINE)
QUESTION = re.compile(r'^Query: (".*")$', re.MULTILINE)
# The beginning of the text that reports the error when a question is asked again.
AGAIN = "You answered before with"


@dataclass
class Call:
    """One call of the model."""
    question: str
    # 1 for the first call of a question, 2 if the model is told what was wrong with its first reply.
    turn: int
    # The server that called: a number from 0, or a name.
    life: object
    arrived: float
    cost_usd: float
    # When the last byte of the reply was handed to the system; None if the caller had disconnected before.
    delivered: float = None


def answer_to(text, question, turn):
    """Returns the six-line reply. The first reply to one question in sixteen names an unknown id, to another one in sixteen no id."""
    ids, dice = [int(found) for found in CANDIDATE.findall(text)], zlib.crc32(question.encode())
    chosen = str(ids[dice // 256 % len(ids)]) if ids else "none"
    if dice % 16 == 0 and turn == 1:
        chosen = "99999"
    elif dice % 16 == 1:
        chosen = "none"
    return (f"Predicted ID: {chosen}\nExplanation: It was drawn by lot for {question}\nCandidate Names: none\n"
            "Target name matches?: true\nAnchor ID: unknown\nRelation used: none")


class Model(ThreadingHTTPServer):
    """Listens on loopback. `pace_s` is its average response time; `life` is the number of the server that currently calls it."""
    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.calls, self.life, self.pace_s = [], 0, 0.01
        self.changed = threading.Condition()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def flags(self):
        """Returns the server flags for this model."""
        return self.flags_of("v1")

    def flags_of(self, path):
        """Returns the flags for one of several servers, whose calls are distinguished by their path, `/NAME/v1`."""
        return ["--vlm-url", f"http://127.0.0.1:{self.server_port}/{path}", "--vlm-model", "scripted", "--vlm-prompt-usd", PROMPT_USD,
                "--vlm-completion-usd", COMPLETION_USD, "--vlm-backoff-ms", 50]

    def wait_for_replies(self, number, within_s):
        """Waits until this many more replies were delivered."""
        with self.changed:
            wanted = self.replies() + number
            self.changed.wait_for(lambda: self.replies() >= wanted, within_s)

    def replies(self):
        return sum(call.delivered is not None for call in self.calls)

    def handle_error(self, request, client_address):
        """Ignores errors of connections to killed callers."""


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    # Otherwise the end of a reply would wait for the acknowledgment of its beginning (Nagle's algorithm).
    disable_nagle_algorithm = True

    def setup(self):
        # A connection belongs to the server that opened it, whenever its data is read.
        self.life = self.server.life
        super().setup()

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        arrived = time.time()
        name = self.path.split("/")[1]
        life = self.life if name == "v1" else name
        content = body["messages"][-1]["content"]
        text = content if isinstance(content, str) else "\n".join(part["text"] for part in content if part["type"] == "text")
        question, turn = json.loads(QUESTION.findall(text)[-1]), 2 if AGAIN in text else 1
        said = answer_to(text, question, turn)
        # Token counts depend on the words only, so the same prompt always costs the same.
        usage = {"prompt_tokens": 1000 + len(text) // 4, "completion_tokens": len(said) // 4}
        cost = (usage["prompt_tokens"] * PROMPT_USD + usage["completion_tokens"] * COMPLETION_USD) / 1e6
        call = Call(question, turn, life, arrived, cost)
        with self.server.changed:
            self.server.calls.append(call)
        # Between half and one and a half of the pace, always the same for a question.
        time.sleep(self.server.pace_s * (0.5 + zlib.crc32(question.encode()) % 1000 / 1000))
        reply = json.dumps({"choices": [{"message": {"role": "assistant", "content": said}}], "usage": usage}).encode()
        head = f"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: {len(reply)}\r\n\r\n".encode()
        self.connection.sendall(head + reply)
        with self.server.changed:
            call.delivered = time.time()
            self.server.changed.notify_all()

    def log_message(self, *_):
        """Does nothing: calls are recorded elsewhere."""
