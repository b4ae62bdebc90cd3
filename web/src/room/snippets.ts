/** The same question from elsewhere. A key is never written out: it is read from the environment. */

import { currentKey } from "../api/key";
import type { GroundRequest } from "../api/types";

const address = (scene: string) => `${location.origin}/v1/scenes/${scene}/ground`;

export function asJson(request: GroundRequest): string {
  return JSON.stringify(request, null, 2);
}

export function asCurl(scene: string, request: GroundRequest): string {
  const body = JSON.stringify(request).replace(/'/g, `'\\''`);
  const key = currentKey() ? ` -H "authorization: Bearer $UNIGROUND_KEY"` : "";
  return `curl -s -X POST ${address(scene)}${key} \\\n  -H 'content-type: application/json' \\\n  -d '${body}'`;
}

export function asPython(scene: string, request: GroundRequest): string {
  const key = currentKey() ? `, "authorization": "Bearer " + os.environ["UNIGROUND_KEY"]` : "";
  return [
    `import json${key && ", os"}, urllib.request`,
    ``,
    `question = json.loads(${JSON.stringify(JSON.stringify(request))})`,
    `request = urllib.request.Request(`,
    `    "${address(scene)}",`,
    `    data=json.dumps(question).encode(),`,
    `    headers={"content-type": "application/json"${key}},`,
    `)`,
    `answer = json.load(urllib.request.urlopen(request))`,
    `print(answer["status"], answer["answer"]["predicted_id"], answer["box"])`,
    ``,
  ].join("\n");
}
