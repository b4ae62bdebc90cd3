/** Sends a scan. By XMLHttpRequest: fetch can not tell how much has gone out. */

import { ProblemError, refusal, unreachable } from "./client";
import { keyHeaders, ownAddress } from "./key";
import type { Created } from "./types";

export interface Sent { bytes: number; total: number }

export function uploadScan(file: File, onSent: (sent: Sent) => void, signal: AbortSignal): Promise<Created> {
  return new Promise((resolve, reject) => {
    const name = file.name.replace(/(\.tar)?\.\w+$/, "").replace(/_/g, " ");
    // As a form: the service goes by the bytes, and by the name's ending where these are only numbers.
    const form = new FormData();
    form.append("scan", file);
    const sending = new XMLHttpRequest();
    sending.open("POST", ownAddress(`/v1/scenes?name=${encodeURIComponent(name)}`));
    for (const [header, value] of Object.entries(keyHeaders())) sending.setRequestHeader(header, value);
    sending.upload.onprogress = (event) => onSent({ bytes: event.loaded, total: event.total });
    sending.onload = () => {
      if (sending.status < 300) resolve(JSON.parse(sending.responseText) as Created);
      else reject(new ProblemError(refusal(sending.status, sending.statusText, sending.responseText)));
    };
    sending.onerror = () => reject(new ProblemError(unreachable()));
    sending.onabort = () => reject(new DOMException("given up", "AbortError"));
    signal.addEventListener("abort", () => sending.abort());
    sending.send(form);
  });
}
