/** The search in the list of objects. */

import type { InstanceView } from "../api/types";
import { t } from "../text";
import { nameOf } from "./names";

const LEFT_OUT = new Set(["the", "a", "an", "all", "of", "in"]);

/** The words of a search in lower case, nouns in the singular. */
export const searchWords = (search: string): string[] =>
  search
    .toLowerCase()
    .split(/[\s,]+/)
    .filter((word) => word && !LEFT_OUT.has(word))
    .map(singular);

/** Whether a row of the list shows all words: in name, colors or number. */
export function fits(thing: InstanceView, words: string[]): boolean {
  const { id, colours, structure } = thing;
  const text = textOf([nameOf(thing), ...Object.keys(colours), structure ?? "", structure ? t.things.structure : ""]);
  return words.every((word) => text.includes(word) || word === String(id));
}

/** Whether the words fit other names that the object may have. */
export function mayFit({ label, model_name, names, colours }: InstanceView, words: string[]): boolean {
  const text = textOf([label, model_name ?? "", ...names.map(({ name }) => name), ...Object.keys(colours)]);
  return words.every((word) => text.includes(word));
}

/** In lower case, and gray in both spellings. */
const textOf = (parts: string[]) => parts.join(" ").toLowerCase().replace(/\bgr[ae]y\b/g, "gray grey");

function singular(word: string): string {
  if (/(ches|shes|sses|xes)$/.test(word)) return word.slice(0, -2);
  if (/[^aeiou]ies$/.test(word)) return `${word.slice(0, -3)}y`;
  if (/lves$/.test(word)) return `${word.slice(0, -3)}f`;
  return /[^s]s$/.test(word) ? word.slice(0, -1) : word;
}
