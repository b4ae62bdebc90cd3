// A client in one file, for browsers and Node 20: `fetch` and nothing else. Its types are those of openapi/openapi.json.
import type { components } from "./api.js";

type Schemas = components["schemas"];
export type Answer = Schemas["Answer"];
export type Job = Schemas["Job"];
/** Everything a question may have; only `query` must be given. */
export type Question = Partial<Schemas["GroundRequest"]> & { query: string };

/** What the server refuses. Decide on `code`: it is stable. */
export class UnigroundError extends Error {
  constructor(
    readonly code: string,
    readonly detail: string,
    readonly status?: number,
    readonly retryAfterS?: number,
  ) {
    super(`${detail} (${code})`);
  }
}

export class Uniground {
  /** In a page: `new Uniground("")`, its own origin. */
  constructor(
    readonly server: string,
    readonly key?: string,
  ) {}

  /** Uploads an archive; comes back when it is stored, not yet parsed. The same `idempotencyKey` again is the same scene. */
  async upload(archive: Blob, idempotencyKey: string = crypto.randomUUID()): Promise<Schemas["Created"]> {
    const headers = { "content-type": "application/zip", "idempotency-key": idempotencyKey };
    return (await this.send("/v1/scenes", { method: "POST", headers, body: archive })).json();
  }

  /** Follows a job to its end. `fetch` reads the events, since `EventSource` can send no key. */
  async follow(jobId: string, onProgress: (job: Job) => void = () => {}): Promise<Job> {
    const reply = await this.send(`/v1/jobs/${jobId}/events`);
    let rest = "";
    for await (const text of decoded(reply.body!)) {
      const lines = (rest + text).split("\n");
      rest = lines.pop()!;
      for (const line of lines) {
        if (line.startsWith("data:")) onProgress(JSON.parse(line.slice("data:".length)));
      }
    }
    // The stream ends early when the server stops; its word on the job still counts.
    return (await this.send(`/v1/jobs/${jobId}`)).json();
  }

  async ask(sceneId: string, question: Question): Promise<Answer> {
    const headers = { "content-type": "application/json" };
    return (await this.send(`/v1/scenes/${sceneId}/ground`, { method: "POST", headers, body: JSON.stringify(question) })).json();
  }

  /** The room with the answer's box. */
  async picture(answer: Answer): Promise<Blob> {
    return (await this.send(`/v1/answers/${answer.id}/evidence/global.jpg`)).blob();
  }

  /** Any request; an `UnigroundError` where it is refused. */
  async send(path: string, request: RequestInit = {}): Promise<Response> {
    const headers = new Headers(request.headers);
    if (this.key) headers.set("authorization", `Bearer ${this.key}`);
    const reply = await fetch(this.server + path, { ...request, headers });
    if (reply.ok) return reply;
    const problem = await reply.json().catch(() => ({ code: "no_problem_document", detail: `${path} answered ${reply.status}` }));
    throw new UnigroundError(problem.code, problem.detail, reply.status, Number(reply.headers.get("retry-after")) || undefined);
  }
}

/** A body as text, piece by piece. Not `for await` over the stream itself: not every browser can. */
async function* decoded(body: ReadableStream<Uint8Array>): AsyncGenerator<string> {
  const reader = body.getReader();
  const decoder = new TextDecoder();
  for (let read = await reader.read(); !read.done; read = await reader.read()) {
    yield decoder.decode(read.value, { stream: true });
  }
}
