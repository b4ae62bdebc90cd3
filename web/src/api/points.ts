/** The cloud's file, by ranges: little at first, for a picture at once; then more and more at a time. */

import { ProblemError, request } from "./client";
import { pointsPath } from "./service";

/** Of the header and 200,000 points. */
const FIRST_BYTES = 32 + 200_000 * 12;
const MOST_BYTES = 32_000_000;
const GROWTH = 2;

/** With `draft`, also the cloud of a room that is still being parsed. */
export async function* pointsFile(scene: string, signal: AbortSignal, draft = false): AsyncGenerator<Uint8Array> {
  const path = pointsPath(scene) + (draft ? "?draft=true" : "");
  let version: string | null = null;
  for (let [at, step, end] = [0, FIRST_BYTES, Infinity]; at < end; step = Math.min(MOST_BYTES, step * GROWTH)) {
    const response = await request(path, { signal, headers: { range: `bytes=${at}-${at + step - 1}` } });
    const whole = response.status === 200;
    // Halves of two clouds are no cloud: it was parsed again in the meantime.
    if (at > 0 && (whole || response.headers.get("etag") !== version)) throw new ProblemError(changed());
    version = response.headers.get("etag");
    end = Number(whole ? response.headers.get("content-length") : response.headers.get("content-range")?.split("/")[1]);
    for await (const bytes of chunksOf(response.body!)) {
      at += bytes.length;
      yield bytes;
    }
  }
}

/** Not every browser of today goes through a stream by itself. */
async function* chunksOf(body: ReadableStream<Uint8Array>): AsyncGenerator<Uint8Array> {
  const reader = body.getReader();
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      yield value;
    }
  } finally {
    void reader.cancel().catch(() => undefined);
  }
}

const changed = () => ({
  type: "about:blank", title: "Changed", status: 0, detail: "The scan was parsed again while its points were fetched.", code: "cloud_changed",
});
