/** Sends a scan. By XMLHttpRequest: fetch can not tell how much has gone out. */

import { ProblemError, refusal, unreachable } from "./client";
import { keyHeaders, ownAddress } from "./key";
import type { Created } from "./types";

/** What the service takes, by the end of the file's name. */
const MEDIA_TYPES: [string, string][] = [
  [".zip", "application/zip"],
  [".tar", "application/x-tar"],
  [".tar.zst", "application/zstd"],
  [".zst", "application/zstd"],
];

export const ACCEPTED = MEDIA_TYPES.map(([end]) => end).join(",");

export function mediaTypeOf(name: string): string | null {
  return MEDIA_TYPES.find(([end]) => name.toLowerCase().endsWith(end))?.[1] ?? null;
}

export interface Sent { bytes: number; total: number }

export function uploadScan(file: File, onSent: (sent: Sent) => void, signal: AbortSignal): Promise<Created> {
  return new Promise((resolve, reject) => {
    const name = file.name.replace(/\.(zip|tar|tar\.zst|zst)$/i, "").replace(/_/g, " ");
    const sending = new XMLHttpRequest();
    sending.open("POST", ownAddress(`/v1/scenes?name=${encodeURIComponent(name)}`));
    sending.setRequestHeader("content-type", mediaTypeOf(file.name) ?? "application/zip");
    for (const [header, value] of Object.entries(keyHeaders())) sending.setRequestHeader(header, value);
    sending.upload.onprogress = (event) => onSent({ bytes: event.loaded, total: event.total });
    sending.onload = () => {
      if (sending.status < 300) resolve(JSON.parse(sending.responseText) as Created);
      else reject(new ProblemError(refusal(sending.status, sending.statusText, sending.responseText)));
    };
    sending.onerror = () => reject(new ProblemError(unreachable()));
    sending.onabort = () => reject(new DOMException("given up", "AbortError"));
    signal.addEventListener("abort", () => sending.abort());
    sending.send(file);
  });
}
