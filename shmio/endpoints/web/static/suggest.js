// Suggestions for a field in which the user types the path of a register.

import { element, replace } from "./dom.js";

const MAX_SUGGESTED = 30;

/**
 * Fill a list with the registers whose path or comment contains the text of a field.
 *
 * @param {import("./connection.js").Connection} connection
 * @param {HTMLInputElement} field
 * @param {HTMLDataListElement} list
 */
export async function suggest(connection, field, list) {
  const filter = field.value;
  const found = await connection.call("registers.rows", { first: 0, count: MAX_SUGGESTED, filter }).catch(() => ({ rows: [] }));
  if (filter !== field.value) return;
  const paths = found.rows.filter((/** @type {any} */ row) => row.type !== undefined).map((/** @type {any} */ row) => row.path);
  replace(list, ...paths.map((/** @type {string} */ path) => element("option", { value: path })));
  connection.call("registers.rows", { first: 0, count: 0 }).catch(() => {}); // it needs no values
}
