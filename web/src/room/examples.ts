/** Questions that make sense in this very room: made of what was found in it. */

import type { InstanceView } from "../api/types";
import { t } from "../text";
import { nameOf } from "./names";

const MOST = 4;

export function examplesFor(instances: Iterable<InstanceView>): string[] {
  const things = [...instances].filter(({ level, structure, dismissed }) => level === "thing" && !structure && !dismissed);
  const byName = new Map<string, InstanceView[]>();
  for (const thing of things) byName.set(nameOf(thing), [...(byName.get(nameOf(thing)) ?? []), thing]);
  const sure = (thing: InstanceView) => (thing.given_name || thing.model_name ? 1 : (thing.names[0]?.score ?? 0));
  const single = things.filter((thing) => byName.get(nameOf(thing))!.length === 1).sort((a, b) => sure(b) - sure(a));
  const several = [...byName.entries()].filter(([, all]) => all.length > 1).sort(([, a], [, b]) => sure(b[0]!) - sure(a[0]!));
  const found = new Map(things.map((thing) => [thing.id, thing]));

  const examples: string[] = [];
  for (const thing of [...things].sort((a, b) => sure(b) - sure(a))) {
    const below = thing.support.on === "instance" ? found.get(thing.support.id) : undefined;
    if (!below || byName.get(nameOf(below))!.length > 1) continue;
    examples.push(t.ask.example.on(nameOf(thing), nameOf(below)));
    break;
  }
  if (single[0]) examples.push(t.ask.example.unique(nameOf(single[0])));
  if (several[0] && single[1]) examples.push(t.ask.example.closest(several[0][0], nameOf(single[1])));
  if (several[1]) examples.push(t.ask.example.count(several[1][0]));
  return examples.slice(0, MOST);
}
