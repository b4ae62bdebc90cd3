/** Bodies that arrive bit by bit: server-sent events, and a JSON text a line. By fetch, because EventSource can show no key. */

import { ProblemError, request } from "./client";
import type { Job } from "./types";

async function* linesOf(response: Response): AsyncGenerator<string> {
  const reader = response.body!.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) break;
      const lines = (rest + value).split("\n");
      rest = lines.pop()!;
      for (const line of lines) yield line.endsWith("\r") ? line.slice(0, -1) : line;
    }
    if (rest) yield rest;
  } finally {
    void reader.cancel().catch(() => undefined);
  }
}

interface ServerEvent { id: string; event: string; data: string }

async function* eventsOf(response: Response): AsyncGenerator<ServerEvent> {
  let event: ServerEvent = { id: "", event: "message", data: "" };
  for await (const line of linesOf(response)) {
    if (line === "") {
      if (event.data) yield event;
      event = { id: event.id, event: "message", data: "" };
    } else {
      const colon = line.indexOf(":");
      const field = colon < 0 ? line : line.slice(0, colon);
      const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
      if (field === "id") event.id = value;
      if (field === "event") event.event = value;
      if (field === "data") event.data += (event.data && "\n") + value;
    }
  }
}

const PATIENCE_MS = [500, 1000, 2000, 5000];

const pause = (ms: number) => new Promise((resolve) => setTimeout(resolve, ms));

/** Refused, and trying again changes nothing. */
function isFinal(thrown: unknown): boolean {
  const status = thrown instanceof ProblemError ? thrown.problem.status : 0;
  return status >= 400 && status < 500 && status !== 408 && status !== 429;
}

/** Follows a job to its end. A connection that breaks is taken up again where it broke. */
export async function followJob(job: string, onProgress: (job: Job) => void, signal?: AbortSignal): Promise<Job> {
  let seen = "";
  for (let failures = 0; ; failures++) {
    try {
      const headers: Record<string, string> = { accept: "text/event-stream" };
      if (seen) headers["last-event-id"] = seen;
      const response = await request(`/v1/jobs/${encodeURIComponent(job)}/events`, { headers, signal });
      for await (const event of eventsOf(response)) {
        failures = 0;
        seen = event.id;
        const state = JSON.parse(event.data) as Job;
        onProgress(state);
        if (event.event === "done") return state;
      }
    } catch (thrown) {
      if (signal?.aborted || failures >= PATIENCE_MS.length || isFinal(thrown)) throw thrown;
    }
    await pause(PATIENCE_MS[Math.min(failures, PATIENCE_MS.length - 1)]!);
  }
}

/** Values of a JSONL body, as they come. */
export async function* jsonLines<T>(path: string, signal?: AbortSignal): AsyncGenerator<T> {
  for await (const line of linesOf(await request(path, { signal }))) {
    if (line.trim()) yield JSON.parse(line) as T;
  }
}
