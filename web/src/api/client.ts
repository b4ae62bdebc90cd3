/** One request, one answer or one problem. Everything the page asks goes through here. */

import type { Problem } from "./types";
import { keyHeaders, keyWanted, ownAddress, serverHasKeys } from "./key";

/** What the service, or the way to it, says is wrong. */
export class ProblemError extends Error {
  constructor(readonly problem: Problem) {
    super(problem.detail);
    this.name = "ProblemError";
  }
}

export async function request(path: string, init: RequestInit = {}): Promise<Response> {
  const headers = { ...keyHeaders(), ...(init.headers as Record<string, string> | undefined) };
  let response: Response;
  try {
    response = await fetch(ownAddress(path), { ...init, headers, credentials: "omit", redirect: "error" });
  } catch (cause) {
    if (init.signal?.aborted) throw cause;
    throw new ProblemError(unreachable());
  }
  if (!response.ok) throw new ProblemError(await problemOf(response));
  return response;
}

export async function json<T>(path: string, init?: RequestInit): Promise<T> {
  return (await (await request(path, init)).json()) as T;
}

export function send<T>(method: string, path: string, body?: unknown, signal?: AbortSignal): Promise<T> {
  const headers = body === undefined ? undefined : { "content-type": "application/json" };
  return json<T>(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), signal });
}

async function problemOf(response: Response): Promise<Problem> {
  return refusal(response.status, response.statusText, await response.text());
}

/** Reads a refusal; a proxy in between may answer with anything. */
export function refusal(status: number, title: string, body: string): Problem {
  let problem: Problem;
  try {
    problem = JSON.parse(body) as Problem;
    if (typeof problem.code !== "string") throw new TypeError("no problem");
  } catch {
    problem = { type: "about:blank", title: title || `HTTP ${status}`, status, detail: body.slice(0, 300), code: `http_${status}` };
  }
  if (status === 401) {
    keyWanted.value = problem.detail;
    serverHasKeys.value = true;
  }
  return problem;
}

export function unreachable(): Problem {
  return { type: "about:blank", title: "No connection", status: 0, detail: "The service did not answer.", code: "no_connection" };
}

/** Whatever was thrown, as a problem that can be shown. */
export function asProblem(thrown: unknown): Problem {
  if (thrown instanceof ProblemError) return thrown.problem;
  const detail = thrown instanceof Error ? thrown.message : String(thrown);
  return { type: "about:blank", title: "The page failed", status: 0, detail, code: "page_failed" };
}

/** Whether it was only given up on: the page moved on. */
export function wasAborted(thrown: unknown): boolean {
  return thrown instanceof DOMException && thrown.name === "AbortError";
}
