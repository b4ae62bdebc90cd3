"""onnxruntime on a bundle of a dual encoder; `benches/peers.rs` starts it and speaks as `protocol.py` says."""

import json
import pathlib
import platform

import numpy as np
import onnxruntime as ort
from protocol import serve, timed


class OnnxRuntime:
    versions = f"onnxruntime {ort.__version__}, numpy {np.__version__}, Python {platform.python_version()}"

    def load(self, folder):
        """Opens both encoders of the bundle in `folder`. Not part of what is compared."""
        folder = pathlib.Path(folder)
        self.model = json.loads((folder / "model.json").read_text())

        def sessions():
            files = ((part, str(folder / self.model[part]["file"])) for part in ("image", "text"))
            return {part: ort.InferenceSession(file, providers=["CPUExecutionProvider"]) for part, file in files}

        ms, self.sessions = timed(sessions)
        return ms, self.model["name"]

    def image(self, batch):
        of = self.model["image"]
        pixels = np.random.default_rng(7).standard_normal((int(batch), 3, *of["size"]), dtype=np.float32)
        return self._run("image", of["output"], {of["input"]: pixels})

    def text(self, batch):
        of = self.model["text"]
        ids = np.tile(np.arange(of["context_length"], dtype=np.int64), (int(batch), 1))
        return self._run("text", of["output"], {of["input_ids"]: ids, of["attention_mask"]: np.ones_like(ids)})

    def _run(self, part, output, inputs):
        ms, (vectors,) = timed(lambda: self.sessions[part].run([output], inputs))
        return ms, " x ".join(map(str, vectors.shape))


serve(OnnxRuntime())
