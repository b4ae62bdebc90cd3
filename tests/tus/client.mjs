// tus-js-client as programs use it: node client.mjs ENDPOINT FILE KEY PART_BYTES, started by run.py.
// Prints the upload's address after two parts and waits for a line; "lost" when nobody answers; at the end where it went on.

import { createReadStream, statSync } from "node:fs";
import { createRequire } from "node:module";
import { basename } from "node:path";
import { createInterface } from "node:readline";

const { Upload } = createRequire(new URL("../../web/package.json", import.meta.url))("tus-js-client");
const [endpoint, file, key, partBytes] = process.argv.slice(2);
const lines = createInterface({ input: process.stdin });

const common = {
  endpoint,
  headers: { authorization: `Bearer ${key}` },
  metadata: { filename: basename(file), name: "by tus-js-client" },
  chunkSize: Number(partBytes),
  uploadSize: statSync(file).size,
  retryDelays: null,
  onError: fail,
};

const first = new Upload(createReadStream(file), {
  ...common,
  async onChunkComplete(_, taken) {
    if (taken !== 2 * common.chunkSize) return;
    await first.abort();
    console.log(first.url);
    lines.once("line", () => goOn(first.url));
  },
});
first.start();

function goOn(uploadUrl) {
  let lost = false;
  let offset;
  const second = new Upload(createReadStream(file), {
    ...common,
    uploadUrl,
    retryDelays: Array(60).fill(500),
    onShouldRetry() {
      if (!lost) console.log("lost");
      return (lost = true);
    },
    onAfterResponse(request, response) {
      if (request.getMethod() === "HEAD") offset = response.getHeader("upload-offset");
    },
    onSuccess() {
      console.log(offset);
      process.exit(0);
    },
  });
  second.start();
}

function fail(error) {
  console.error(error);
  process.exit(1);
}
