// A room that is still a draft: it can be used, it says so, and the full parse takes its place.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { drawn, keep, openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

const JOB = "01900000-0000-7000-8000-000000000000";

let service, browser, scene;
before(async () => {
  service = await startService();
  browser = await startBrowser();
  scene = await parsedSample(service.api);
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

/** As a service with neural networks tells it, whose full parse ends when `finish` is called. */
async function tellOfDraft(page) {
  const state = { done: false };
  await page.route(`**/v1/scenes/${scene.id}`, async (route) => {
    const reply = await route.fetch();
    const told = await reply.json();
    const draft = { quality: "draft", job_id: JOB };
    await route.fulfill({ response: reply, json: state.done ? { ...told, quality: "full", job_id: JOB, parse_version: told.parse_version + 1 } : { ...told, ...draft } });
  });
  const job = { id: JOB, kind: "full_parse", subject: scene.id, stage: "masks_and_lifting", attempts: 1, message: null, error: null };
  await page.route(`**/v1/jobs/${JOB}/events`, (route) => {
    const now = state.done
      ? { event: "done", job: { ...job, state: "succeeded", progress: 1, eta_s: null } }
      : { event: "progress", job: { ...job, state: "running", progress: 0.4, eta_s: 180 } };
    return route.fulfill({ contentType: "text/event-stream", body: `id: ${state.done ? 2 : 1}\nevent: ${now.event}\ndata: ${JSON.stringify(now.job)}\n\n` });
  });
  return () => (state.done = true);
}

test("a draft says that the full parse runs, and then shows it", async () => {
  const { page, complaints, close } = await openPage(browser, service.page);
  const finish = await tellOfDraft(page);
  await page.goto(`${service.page}/#/scenes/${scene.id}`);
  await drawn(page);
  const running = page.getByText("Draft. The full parse is running, about 3 min left.");
  await running.waitFor();
  await keep(page, "draft");
  // The draft answers.
  await page.getByLabel("Question").fill("the mug on the coffee table");
  await page.keyboard.press("Enter");
  await page.getByRole("article", { name: "Answer" }).waitFor();
  finish();
  await page.getByText(/^The full parse is done: \d+ objects\./).waitFor();
  await running.waitFor({ state: "detached" });
  await drawn(page);
  assert.deepEqual(complaints, []);
  await close();
});
