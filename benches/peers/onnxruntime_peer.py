"""onnxruntime with a segmenter's bundle. `benches/peers.rs` starts it and uses the protocol of `protocol.py`."""

import json
import pathlib
import platform

import numpy as np
import onnxruntime as ort
from protocol import serve, timed


class OnnxRuntime:
    versions = f"onnxruntime {ort.__version__}, numpy {np.__version__}, Python {platform.python_version()}"

    def load(self, folder, encoder_threads, decoder_threads):
        """Opens encoder and decoder of the bundle in `folder` and encodes noise. Not timed."""
        folder = pathlib.Path(folder)
        self.model = json.loads((folder / "model.json").read_text())

        def session(part, threads):
            options = ort.SessionOptions()
            options.intra_op_num_threads, options.inter_op_num_threads = int(threads), 1
            options.add_session_config_entry("session.intra_op.allow_spinning", "0")
            return ort.InferenceSession(str(folder / self.model[part]["file"]), options, providers=["CPUExecutionProvider"])

        ms, (self.encoder, self.decoder) = timed(lambda: (session("encoder", encoder_threads), session("decoder", decoder_threads)))
        size = self.model["encoder"]["size"]
        self.picture = np.random.default_rng(7).standard_normal((1, 3, size, size), dtype=np.float32)
        self.encode()
        return ms, self.model["name"]

    def encode(self):
        of = self.model["encoder"]
        names = of["outputs"]
        ms, made = timed(lambda: self.encoder.run(list(names.values()), {of["input"]: self.picture}))
        self.features = dict(zip(names, made))
        return ms, " x ".join(map(str, made[0].shape))

    def decode(self, prompts):
        of, count = self.model["decoder"], int(prompts)
        inputs, side = of["inputs"], of["mask_size"]
        fed = {inputs[role]: values for role, values in self.features.items()}
        fed[inputs["point_coords"]] = np.full((count, 1, 2), 500, np.float32)
        fed[inputs["point_labels"]] = np.ones((count, 1), np.float32)
        if inputs["mask_input"]:
            fed[inputs["mask_input"]] = np.zeros((count, 1, side, side), np.float32)
            fed[inputs["has_mask_input"]] = np.zeros(1, np.float32)
        ms, (masks, _) = timed(lambda: self.decoder.run([of["outputs"]["masks"], of["outputs"]["iou"]], fed))
        return ms, " x ".join(map(str, masks.shape))


serve(OnnxRuntime())
