// A chat endpoint on loopback that says what it is told to: the first reply names nothing that was offered, the next is right.

import { createServer } from "node:http";

export async function scriptedModel(replies) {
  let calls = 0;
  const server = createServer(async (asked, answer) => {
    let body = "";
    for await (const chunk of asked) body += chunk;
    // The service looks once whether anybody is there, without pictures.
    const text = body.includes("image_url") ? replies[Math.min(calls++, replies.length - 1)] : "here";
    answer.setHeader("content-type", "application/json");
    answer.end(JSON.stringify({ choices: [{ message: { role: "assistant", content: text } }], usage: { prompt_tokens: 700, completion_tokens: 40 } }));
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  return { address: `http://127.0.0.1:${server.address().port}/v1`, calls: () => calls, close: () => server.close() };
}

export const sixLines = (id) =>
  `Predicted ID: ${id}\nExplanation: it stands on the table\nCandidate Names: ${id} -> orange mug\n` +
  `Target name matches?: true\nAnchor ID: 25\nRelation used: on the coffee table`;
