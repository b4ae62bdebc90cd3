"""Serves the networks of bundles with a real server of the KServe v2 protocol (the Python package kserve), for tests of remote inference.

    server.py PORT BUNDLE...          names are <bundle>-<file without extension>, as uniground asks for them
"""

import json
import pathlib
import sys

import kserve
import numpy as np
import onnxruntime as ort

TYPES = {"tensor(float)": "FP32", "tensor(int64)": "INT64"}


class Network(kserve.Model):
    def __init__(self, name, file):
        super().__init__(name)
        self.session = ort.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        self.ready = True

    def _described(self, ports):
        shape = lambda port: [d if isinstance(d, int) else -1 for d in port.shape]
        return [{"name": p.name, "datatype": TYPES[p.type], "shape": shape(p)} for p in ports]

    async def get_input_types(self):
        return self._described(self.session.get_inputs())

    async def get_output_types(self):
        return self._described(self.session.get_outputs())

    async def predict(self, request, headers=None, response_headers=None):
        fed = {i.name: i.as_numpy() for i in request.inputs}
        wanted = [o.name for o in request.request_outputs] if request.request_outputs else [o.name for o in self.session.get_outputs()]
        made = self.session.run(wanted, fed)
        outputs = []
        for name, values in zip(wanted, made):
            output = kserve.InferOutput(name=name, shape=list(values.shape), datatype="FP32")
            output.set_data_from_numpy(np.ascontiguousarray(values), binary_data=request.use_binary_outputs)
            outputs.append(output)
        return kserve.InferResponse(response_id=request.id, model_name=self.name, infer_outputs=outputs)


def networks(folder):
    folder = pathlib.Path(folder)
    manifest = json.loads((folder / "model.json").read_text())
    parts = [part for part in ("image", "text", "encoder", "decoder") if part in manifest]
    # Two towers can be one network.
    for file in dict.fromkeys(manifest[part]["file"] for part in parts):
        yield Network(f"{manifest['name']}-{pathlib.Path(file).stem}", folder / file)


if __name__ == "__main__":
    models = [network for folder in sys.argv[2:] for network in networks(folder)]
    kserve.ModelServer(http_port=int(sys.argv[1]), workers=1, enable_grpc=False).start(models)
