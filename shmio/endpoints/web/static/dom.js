// Builds and updates elements. Text always becomes a text node, so no value can become markup.

/**
 * Create an element.
 *
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} name
 * @param {Record<string, string | number | boolean | EventListener | null | undefined>} [attributes] Functions become
 *   listeners of the event that their key names; true is an attribute without a value; false, null and undefined are none.
 * @param {...(Node | string | number | null | undefined)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(key, value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, String(value));
  }
  made.append(...present(children));
  return made;
}

/**
 * Replace what an element contains.
 *
 * @param {Element} parent
 * @param {...(Node | string | number | null | undefined)} children
 */
export function replace(parent, ...children) {
  parent.replaceChildren(...present(children));
}

/**
 * Set the text of an element, if it differs. An unchanged text keeps the user's selection.
 *
 * @param {Element} target
 * @param {string} text
 */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

/**
 * Return the element of this page that has an id.
 *
 * @param {string} id
 * @returns {HTMLElement}
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`the page has no element ${id}`);
  return found;
}

/**
 * Show a message on top of the page, until the user closes it or six seconds are over.
 *
 * @param {string} text
 * @param {"info" | "problem"} kind
 */
export function notify(text, kind = "info") {
  const box = element("p", { class: `notice ${kind}`, role: kind === "problem" ? "alert" : "status" }, text);
  box.addEventListener("click", () => box.remove());
  document.body.append(box);
  setTimeout(() => box.remove(), 6000);
}

/** @param {(Node | string | number | null | undefined)[]} children */
function present(children) {
  return children
    .filter((child) => child !== null && child !== undefined)
    .map((child) => (child instanceof Node ? child : String(child)));
}
