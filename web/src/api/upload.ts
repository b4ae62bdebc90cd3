/** Sends a scan in parts (tus 1.0): what was sent stays sent, through a lost connection, and when the same file is chosen after a reload. */

import type { DetailedError, Upload as Sending } from "tus-js-client";
import { ProblemError, json, refusal, unreachable } from "./client";
import { keyHeaders, ownAddress } from "./key";
import { getJob, getScene } from "./service";
import type { Created, Upload } from "./types";

export interface Sent { bytes: number; total: number }

/** What is sent again at most when a connection is lost. */
const PART_BYTES = 64 << 20;
/** Longer together than the service waits for a sender that it does not know to be gone. */
const TRY_AGAIN_MS = [0, 1000, 3000, 5000, 10_000, 20_000, 30_000];
const ASK_AGAIN_MS = 1000;

export async function uploadScan(file: File, onSent: (sent: Sent) => void, signal: AbortSignal): Promise<Created> {
  const { Upload: Tus } = await import("tus-js-client");
  const name = file.name.replace(/(\.tar)?\.\w+$/, "").replace(/_/g, " ");
  let sending!: Sending;
  let stop!: () => void;
  const sent = new Promise<void>((resolve, reject) => {
    sending = new Tus(file, {
      endpoint: ownAddress("/v1/uploads"),
      headers: keyHeaders(),
      // The service goes by the bytes, and by the name's ending where these are only numbers.
      metadata: { filename: file.name, name },
      chunkSize: PART_BYTES,
      retryDelays: TRY_AGAIN_MS,
      onShouldRetry: (error) => mayPass(statusOf(error)),
      removeFingerprintOnSuccess: true,
      onProgress: (bytes, total) => onSent({ bytes, total: total ?? file.size }),
      onSuccess: () => resolve(),
      onError: (error) => reject(problemOf(error)),
    });
    stop = () => reject(new DOMException("given up", "AbortError"));
  });
  signal.addEventListener("abort", stop);
  try {
    const [before] = (await sending.findPreviousUploads()).filter(({ uploadUrl }) => uploadUrl?.startsWith(ownAddress("/v1/uploads/")));
    signal.throwIfAborted();
    if (before) sending.resumeFromPreviousUpload(before);
    sending.start();
    await sent;
    return await madeOf(sending.url!, signal);
  } catch (thrown) {
    // What can not be gone on with is not gone on with: the same file begins anew.
    const isLost = thrown instanceof ProblemError && mayPass(thrown.problem.status);
    await sending.abort(!isLost).catch(() => {});
    throw thrown;
  } finally {
    signal.removeEventListener("abort", stop);
  }
}

/** The scene an upload has become. */
async function madeOf(address: string, signal: AbortSignal): Promise<Created> {
  for (;;) {
    const { state, problem, scene_id, job_id } = await json<Upload>(new URL(address).pathname, { signal });
    if (scene_id) {
      const [scene, job] = await Promise.all([getScene(scene_id, signal), job_id ? getJob(job_id) : null]);
      return { scene, job };
    }
    if (problem) throw new ProblemError(problem);
    if (state !== "making") throw new ProblemError(unreachable());
    await new Promise((resolve) => setTimeout(resolve, ASK_AGAIN_MS));
    signal.throwIfAborted();
  }
}

/** Whether the same may go well a while later: no answer, somebody else's turn, too much at once, a proxy whose service is away. */
function mayPass(status: number): boolean {
  return [0, 409, 423, 429, 502, 503, 504].includes(status);
}

function statusOf(error: Error | DetailedError): number {
  return ("originalResponse" in error && error.originalResponse?.getStatus()) || 0;
}

function problemOf(error: Error | DetailedError): ProblemError {
  const response = "originalResponse" in error ? error.originalResponse : null;
  return new ProblemError(response ? refusal(response.getStatus(), "", response.getBody()) : unreachable());
}
