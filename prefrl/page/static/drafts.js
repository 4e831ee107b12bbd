/** What somebody has begun to show and not sent: kept for this tab, so that a reload costs nothing. */

const NAME = "prefrl.draft.";

export const drafts = {
  get(id) {
    try {
      return JSON.parse(sessionStorage.getItem(NAME + id) ?? "null");
    } catch {
      return null;
    }
  },
  /** `value` null to forget it. */
  set(id, value) {
    try {
      if (value === null) sessionStorage.removeItem(NAME + id);
      else sessionStorage.setItem(NAME + id, JSON.stringify(value));
    } catch {
      // A full or forbidden storage costs only this.
    }
  },
};
