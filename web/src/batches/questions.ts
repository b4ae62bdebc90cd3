/** Reads a list of questions: one a line, or JSONL with the API's own fields. */

export type Item = Record<string, unknown>;

export interface BadLine { line: number }

export function readQuestions(text: string): Item[] | BadLine {
  const items: Item[] = [];
  const lines = text.split(/\r?\n/);
  for (let i = 0; i < lines.length; i++) {
    const line = lines[i]!.trim();
    if (!line) continue;
    if (!line.startsWith("{")) {
      items.push({ query: line });
      continue;
    }
    try {
      items.push(JSON.parse(line) as Item);
    } catch {
      return { line: i + 1 };
    }
  }
  return items;
}
