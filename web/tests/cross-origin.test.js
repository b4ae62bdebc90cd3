// A page of somebody else's, on an origin of its own: what it may do where the service was told of it, and what it may not where not.

import assert from "node:assert/strict";
import { createServer } from "node:http";
import { after, before, test } from "node:test";
import { openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

const KEY = "a-key-for-tests-0123456789abcdef0123456789";
const QUESTION = { query: "the mug on the coffee table", include: [] };
const authorization = `Bearer ${KEY}`;

let named, stranger, service, browser, scene;
before(async () => {
  named = await origin();
  stranger = await origin();
  service = await startService({ further: ["--cors-origin", named.address], environment: { UNIGROUND_API_KEY: KEY } });
  browser = await startBrowser();
  scene = await parsedSample(service.api, { authorization });
});
after(async () => {
  await browser?.close();
  await service?.stop();
  named?.close();
  stranger?.close();
});

/** Serves the same small page at every path. */
async function origin() {
  const server = createServer((_, answer) => {
    answer.setHeader("content-type", "text/html; charset=utf-8");
    answer.end(PAGE);
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  return {
    address: `http://127.0.0.1:${server.address().port}`,
    close() {
      server.close();
      server.closeAllConnections();
    },
  };
}

const PAGE = `<!doctype html>
<html lang="en">
<link rel="icon" href="data:,">
<title>Robots</title>
<h1>Robots</h1>
<img id="room" alt="The room from above">
<form method="post"></form>
<script>
  const { api, key } = Object.fromEntries(new URLSearchParams(location.search));

  async function call(path, body) {
    const headers = { authorization: "Bearer " + key };
    if (body) headers["content-type"] = "application/json";
    const reply = await fetch(api + path, body ? { method: "POST", headers, body: JSON.stringify(body) } : { headers });
    const said = await reply.json();
    if (!reply.ok) throw new Error(said.code + ": " + said.detail);
    return said;
  }

  function show(address) {
    const image = document.querySelector("#room");
    return new Promise((resolve, reject) => {
      image.onload = () => resolve([image.naturalWidth, image.naturalHeight]);
      image.onerror = () => reject(new Error("no picture"));
      image.src = address;
    });
  }

  async function points(address, range) {
    const reply = await fetch(address, { headers: { range } });
    const view = new DataView(await reply.arrayBuffer());
    const magic = String.fromCharCode(...new Uint8Array(view.buffer, 0, 4));
    return { status: reply.status, told: reply.headers.get("content-range"), bytes: view.byteLength, magic, count: view.getUint32(4, true) };
  }

  function follow(address) {
    const events = new EventSource(address);
    const progress = [];
    return new Promise((resolve, reject) => {
      events.addEventListener("progress", (event) => progress.push(JSON.parse(event.data)));
      events.addEventListener("done", (event) => {
        events.close();
        resolve({ progress, job: JSON.parse(event.data) });
      });
      events.onerror = () => events.readyState === EventSource.CLOSED && reject(new Error("no events"));
    });
  }
</script>
</html>`;

const open = (at, { api } = service) => openPage(browser, `${at.address}/?${new URLSearchParams({ api, key: KEY })}`);

/** How many scenes a service has. */
const scenes = ({ api }) =>
  fetch(`${api}/v1/scenes`, { headers: { authorization } })
    .then((reply) => reply.json())
    .then((body) => body.scenes.length);

test("a page of an origin that is named asks with the key, and shows and follows by links", async () => {
  const { page, complaints, close } = await open(named);
  const sent = [];
  page.on("request", (request) => sent.push(request));

  const list = await page.evaluate(() => call("/v1/scenes"));
  assert.ok(list.scenes.some(({ id }) => id === scene.id));

  const post = (path, body) => page.evaluate(([path, body]) => call(path, body), [path, body]);
  const answer = await post(`/v1/scenes/${scene.id}/ground`, QUESTION);
  assert.equal(answer.status, "uncertain");
  assert.match(answer.answer.explanation, /mug/);

  // Other settings, so that there is work to follow.
  const job = await post(`/v1/scenes/${scene.id}/parse`, { settings: { parsing: { superpoints: { seed_m: 0.2 } } } });
  const paths = [`/v1/scenes/${scene.id}/*`, `/v1/jobs/${job.id}/events`];
  const { links } = await post("/v1/links", { paths, expires_in_s: 60 });
  assert.deepEqual(links.map(({ path }) => path), paths);
  const [below, events] = links;
  assert.equal(below.url ?? null, null);
  const linked = (path, token = below.token) => `${service.api}${path}?link=${encodeURIComponent(token)}`;

  // From here on nobody shows the key.
  sent.length = 0;
  const followed = await page.evaluate((address) => follow(address), service.api + events.url);
  assert.equal(followed.job.id, job.id);
  assert.equal(followed.job.state, "succeeded");
  assert.ok(followed.progress.length > 0);

  assert.deepEqual(await page.evaluate((address) => show(address), linked(`/v1/scenes/${scene.id}/thumbnail.jpg`)), [320, 240]);

  const part = await page.evaluate((address) => points(address, "bytes=0-12031"), linked(`/v1/scenes/${scene.id}/points.bin`));
  assert.equal(part.status, 206);
  assert.equal(part.bytes, 12032);
  assert.equal(part.magic, "UGP1");
  assert.equal(part.told, `bytes 0-12031/${32 + 12 * part.count}`);

  assert.deepEqual(sent.map((request) => new URL(request.url()).pathname.split("/").at(-1)), ["events", "thumbnail.jpg", "points.bin"]);
  for (const request of sent) assert.equal((await request.allHeaders()).authorization, undefined);
  assert.deepEqual(complaints, []);

  // A link opens what it names, and nothing beside it.
  for (const [address, status] of [
    [linked("/v1/scenes"), 401],
    [linked(`/v1/scenes/${scene.id}/thumbnail.jpg`, events.token), 401],
    [`${service.api}/v1/scenes/${scene.id}/thumbnail.jpg`, 401],
  ]) {
    assert.equal(await page.evaluate((address) => fetch(address).then((reply) => reply.status), address), status, address);
  }
  await close();
});

test("a page of any other origin reads nothing, even with the key", async () => {
  const { page, complaints, close } = await open(stranger);
  await assert.rejects(page.evaluate(() => call("/v1/scenes")), /Failed to fetch/);
  const ask = page.evaluate(([id, question]) => call(`/v1/scenes/${id}/ground`, question), [scene.id, QUESTION]);
  await assert.rejects(ask, /Failed to fetch/);
  assert.ok(complaints.length > 0 && complaints.every((text) => /blocked by CORS policy/.test(text)), complaints.join("\n"));
  await close();
});

for (const { title, environment } of [
  { title: "with a key", environment: { UNIGROUND_API_KEY: KEY } },
  { title: "without a key", environment: {} },
]) {
  test(`what browsers send unasked changes nothing when it comes from any other origin, ${title}`, async (test) => {
    const other = await startService({ further: ["--cors-origin", named.address], environment, empty: true });
    test.after(() => other.stop());
    const address = `${other.api}/v1/scenes/sample`;
    const unasked = async (page) => {
      const [reply] = await Promise.all([
        page.waitForResponse(address),
        page.evaluate((address) => fetch(address, { method: "POST", mode: "no-cors" }).then(() => {}, () => {}), address),
      ]);
      return reply.status();
    };

    const { page, close } = await open(stranger, other);
    assert.equal(await unasked(page), 403);
    await assert.rejects(page.evaluate((address) => fetch(address, { method: "POST" }).then(() => {}), address), /Failed to fetch/);
    const [reply] = await Promise.all([
      page.waitForNavigation(),
      page.evaluate((address) => {
        const form = document.querySelector("form");
        form.action = address;
        form.submit();
      }, address),
    ]);
    assert.equal(reply.request().method(), "POST");
    assert.equal((await reply.request().allHeaders()).origin, stranger.address);
    assert.equal(reply.status(), 403);
    assert.equal((await reply.json()).code, "origin_not_allowed");
    assert.equal(await scenes(other), 0);
    await close();

    // It is the origin that was refused: from one that is named the same goes through, where no key is wanted.
    const trusted = await open(named, other);
    assert.equal(await unasked(trusted.page), environment.UNIGROUND_API_KEY ? 401 : 202);
    assert.equal(await scenes(other), environment.UNIGROUND_API_KEY ? 0 : 1);
    await trusted.close();
  });
}
