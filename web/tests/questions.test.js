// Kinds of questions: sentences, follow-up questions, and measured lines.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { openPage, startBrowser } from "./support/browser.js";
import { parsedSample, startService } from "./support/service.js";

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

async function ask(page, question) {
  const asked = page.waitForResponse(/\/ground$/);
  await page.getByLabel("Question").fill(question);
  await page.keyboard.press("Enter");
  const answer = await (await asked).json();
  await page.locator(`[data-answer="${answer.id}"]`).waitFor();
  return answer;
}

test("a distance is a sentence, and its follow-up question leans on the answer", async () => {
  const { page, complaints, close } = await openPage(browser, `${service.page}/#/scenes/${scene.id}`);
  const first = await ask(page, "how far is the green stool from the sofa?");
  assert.equal(first.kind, "measure");
  assert.equal(first.value.line.length, 2);
  await page.getByText(first.text).waitFor();
  const second = await ask(page, "how tall is it?");
  assert.equal(second.understood_as, `how tall is #${first.answer.predicted_id}`);
  await page.getByText(`Understood as: ${second.understood_as}`).waitFor();
  assert.deepEqual(complaints, []);
  await close();
});

test("a list names what it found, and each object can be chosen", async () => {
  const { page, complaints, close } = await openPage(browser, `${service.page}/#/scenes/${scene.id}`);
  const list = await ask(page, "what is on the dining table?");
  assert.equal(list.kind, "list");
  assert.ok(list.targets.length > 1, list.text);
  const card = page.getByRole("article", { name: "Answer" });
  await card.getByText(list.text).waitFor();
  assert.ok((await card.locator(".line").count()) >= list.targets.length);
  assert.deepEqual(complaints, []);
  await close();
});
