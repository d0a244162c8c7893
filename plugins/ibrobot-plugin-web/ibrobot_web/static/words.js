// The page's words in the language of the browser: English as it stands in the code, or a table in `words/`.

const LANGUAGES = ["zh"];
const wanted = localStorage.getItem("language") ?? navigator.language;
const language = LANGUAGES.find((each) => wanted.toLowerCase().startsWith(each));
const table = language ? (await import(`./words/${language}.js`)).default : {};
if (language) document.documentElement.lang = language;
// Those that are filled in, the longest first: it says most.
const filled = Object.entries(table).filter(([text]) => text.includes("{}")).sort(([a], [b]) => b.length - a.length)
  .map(([text, words]) => [new RegExp(`^${text.split("{}").map((part) => part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")).join("(.+?)")}$`), words]);
const known = new Map(Object.entries(table));
const before = new Map(); // what was looked up
const MOST = 2000;
const ONE = /\b1 ((?:more |other |recorded )?[a-z]{3,})\b/g;

// A text in the language of the browser; what no table has stays as it is.
export function words(text) {
  if (!language || typeof text !== "string") return text;
  const inner = text.trim();
  return inner ? text.replace(inner, () => lookUp(inner)) : text;
}

function lookUp(text) {
  let found = known.get(text) ?? before.get(text);
  if (found === undefined) {
    const many = text.replace(ONE, "1 $1s"); // tables have one entry for `1 episode` and `2 episodes`
    found = filledIn(text) ?? (many === text ? undefined : known.get(many) ?? filledIn(many)) ?? text;
    if (before.size > MOST) before.clear();
    before.set(text, found);
  }
  return found;
}

function filledIn(text) {
  for (const [pattern, template] of filled) {
    const match = pattern.exec(text);
    if (!match) continue;
    let i = 0;
    return template.replaceAll("{}", () => words(match[++i]));
  }
  return undefined;
}
