// What cannot be done, as one sentence for the visitor.
export class Refusal extends Error {}

// A value from a file, for a sentence: short, and in printable letters.
export function quoted(value) {
    const text = (JSON.stringify(value) ?? String(value)).replace(/[^ -~]/g, "?");
    return text.length > 60 ? `${text.slice(0, 60)}...` : text;
}
