// A vision-language model decides, played by a script: everything it was shown and said can be looked at.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { keep, openPage, startBrowser } from "./support/browser.js";
import { scriptedModel, sixLines } from "./support/model.js";
import { parsedSample, startService } from "./support/service.js";

let model, service, browser, scene;
before(async () => {
  model = await scriptedModel([sixLines(4711), sixLines(80)]);
  const priced = ["--vlm-url", model.address, "--vlm-model", "scripted", "--vlm-prompt-usd", "2", "--vlm-completion-usd", "8", "--vlm-backoff-ms", "1"];
  service = await startService({ further: priced });
  browser = await startBrowser();
  scene = await parsedSample(service.api);
});
after(async () => {
  await browser?.close();
  await service?.stop();
  model?.close();
});

test("why: renders, collages, prompts, replies, corrections, tokens, cost and seconds", async () => {
  const { page, complaints, close } = await openPage(browser, `${service.page}/#/scenes/${scene.id}`);
  await page.getByLabel("Question").fill("the mug on the coffee table");
  await page.getByText("Answer options").click();
  await page.getByLabel("Chosen by").selectOption("vlm");
  await page.getByRole("button", { name: "Ask", exact: true }).click();
  await page.getByRole("button", { name: "Why this answer" }).click();
  const why = page.locator(".why");
  await why.getByText("Call 2: asked again: no candidate has that number").waitFor();
  await keep(page, "why-by-a-model");
  const text = await why.textContent();
  assert.match(text, /2 calls · 1,400 \+ 80 tokens · \$0\.00344/);
  assert.match(text, /Predicted ID: 4711/);
  assert.match(text, /Predicted ID: 80/);
  assert.match(text, /Query: "the mug on the coffee table"/);
  assert.match(text, /Corrections.*4711/s);
  assert.match(text, /System prompt/);
  const pictures = why.locator("figure .picture");
  assert.ok((await pictures.count()) > 5, `${await pictures.count()} pictures`);
  await pictures.first().scrollIntoViewIfNeeded();
  await pictures.first().locator("img").waitFor();
  assert.deepEqual(complaints, []);
  await close();
});
