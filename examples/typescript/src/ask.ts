// node dist/ask.js SCAN.zip "the mug on the coffee table"
import { openAsBlob } from "node:fs";
import { writeFile } from "node:fs/promises";
import { Uniground, UnigroundError } from "./uniground.js";

const [scan, query] = process.argv.slice(2);
if (!scan || !query) {
  console.error('usage: node dist/ask.js SCAN.zip "the mug on the coffee table"');
  process.exit(2);
}
const { UNIGROUND_SERVER: server = "http://127.0.0.1:8080", UNIGROUND_API_KEY: key } = process.env;
const uniground = new Uniground(server, key);
try {
  const { scene, job } = await uniground.upload(await openAsBlob(scan));
  const done = await uniground.follow(job!.id, (job) => console.error(`${job.stage ?? job.state}: ${Math.round(job.progress * 100)} %`));
  if (done.error) throw new UnigroundError(done.error.code, done.error.detail);

  const answer = await uniground.ask(scene.id, { query });
  console.log(answer.status, answer.targets?.map((target) => `${target.name} (${target.id})`).join(", "), answer.oriented_box);
  console.log(answer.answer.explanation);
  await writeFile("answer.jpg", Buffer.from(await (await uniground.picture(answer)).arrayBuffer()));
} catch (error) {
  console.error(error instanceof UnigroundError ? error.message : error);
  process.exitCode = 1;
}
