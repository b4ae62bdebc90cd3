// Serves web/dist before a service's API, with the headers of src/http/page.rs: for tests of a page that is not in the program yet.

import { createServer, request } from "node:http";
import { readFileSync } from "node:fs";
import { extname } from "node:path";
import { gzipSync } from "node:zlib";

export const POLICY =
  "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; " +
  "base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const TYPES = { ".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8", ".svg": "image/svg+xml", ".txt": "text/plain; charset=utf-8" };

const dist = new URL("../../dist/", import.meta.url);

/** A front for the service at `address`; what `instead` gives for a path is answered in the service's place. */
export function front(address, instead = () => null) {
  const { hostname, port } = new URL(address);
  const server = createServer((asked, answer) => {
    const path = asked.url.split("?")[0];
    const other = instead(path);
    if (other) return void sendRange(asked, answer, other);
    const file = path === "/" || path === "/viewer" ? "index.html" : path.startsWith("/assets/") ? path.slice(1) : null;
    if (!file) {
      const passed = request({ hostname, port, path: asked.url, method: asked.method, headers: asked.headers }, (reply) => {
        answer.writeHead(reply.statusCode, reply.headers);
        reply.pipe(answer);
      });
      passed.on("error", () => answer.destroy());
      answer.on("close", () => passed.destroy());
      return void asked.pipe(passed);
    }
    answer.setHeader("content-type", TYPES[extname(file)]);
    answer.setHeader("content-security-policy", POLICY);
    answer.setHeader("x-content-type-options", "nosniff");
    answer.setHeader("content-encoding", "gzip");
    answer.end(gzipSync(readFileSync(new URL(file, dist))));
  });
  return new Promise((resolve) => {
    server.listen(0, "127.0.0.1", () => resolve({ address: `http://127.0.0.1:${server.address().port}`, close: () => server.close() }));
  });
}

/** As the service sends a file: whole, or the range that was asked for. */
function sendRange(asked, answer, bytes) {
  const [, first, last] = /^bytes=(\d+)-(\d+)$/.exec(asked.headers.range ?? "") ?? [];
  answer.setHeader("etag", '"grown"');
  if (first === undefined) {
    answer.setHeader("content-length", bytes.length);
    return answer.end(bytes);
  }
  const part = bytes.subarray(Number(first), Number(last) + 1);
  answer.writeHead(206, { "content-length": part.length, "content-range": `bytes ${first}-${Number(first) + part.length - 1}/${bytes.length}` });
  answer.end(part);
}
