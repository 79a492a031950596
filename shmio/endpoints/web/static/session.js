// Who uses the page: signing in with a token, and out.

import { element } from "./dom.js";

/** @typedef {{ instance: string, name: string, roles: string[], takes_tokens: boolean, tabs: string[] }} Session `tabs`: names of the tabs that the server offers. */

/** @returns {Promise<Session>} */
export async function session() {
  return (await fetch("session")).json();
}

/** @returns {Promise<Session>} */
export async function signOut() {
  return (await fetch("session", { method: "DELETE" })).json();
}

/**
 * Ask for a token until the server accepts one, or the user gives up.
 *
 * @returns {Promise<Session | null>}
 */
export function signIn() {
  const token = element("input", { type: "password", autocomplete: "current-password", required: true, name: "token" });
  const problem = element("p", { class: "problem", role: "alert" });
  const cancel = element("button", { type: "button" }, "Cancel");
  const form = element(
    "form",
    {},
    element("label", {}, "Token ", token),
    problem,
    element("div", {}, element("button", { type: "submit" }, "Sign in"), " ", cancel),
  );
  const dialog = element("dialog", { "aria-label": "Sign in" }, form);
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((done) => {
    /** @param {Session | null} result */
    const end = (result) => {
      dialog.remove();
      done(result);
    };
    cancel.addEventListener("click", () => end(null));
    dialog.addEventListener("cancel", () => end(null));
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const answer = await fetch("session", { method: "POST", body: JSON.stringify({ token: token.value }) });
      const found = await answer.json();
      if (answer.ok) end(found);
      else problem.textContent = found.error;
    });
  });
}
