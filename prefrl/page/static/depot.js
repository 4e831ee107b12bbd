/** Where unsent answers wait: IndexedDB, else localStorage, else memory. Each keeps items `{id, ...}` by their id. */

const DATABASE = "prefrl";
const TABLE = "outbox";
const PREFIX = "prefrl.outbox.";
const PATIENCE = 2000;

/** The best place that works in this browser. */
export async function openDepot() {
  for (const open of [openDatabase, openStorage]) {
    try {
      const depot = await open();
      await depot.all();
      return depot;
    } catch {
      // Private windows and strict settings forbid some of these: the next one is tried.
    }
  }
  return memory();
}

/** Put first, and fall back to memory for what cannot be kept, so that no answer is refused for want of disk. */
export function guarded(depot) {
  const spare = memory();
  return {
    kind: depot.kind,
    async put(item) {
      await depot.put(item).catch(() => spare.put(item));
    },
    async remove(id) {
      await spare.remove(id);
      await depot.remove(id).catch(() => undefined);
    },
    async all() {
      return [...(await depot.all().catch(() => [])), ...(await spare.all())];
    },
  };
}

function memory() {
  const items = new Map();
  return {
    kind: "memory",
    put: async (item) => void items.set(item.id, item),
    remove: async (id) => void items.delete(id),
    all: async () => [...items.values()],
  };
}

async function openStorage() {
  const probe = `${PREFIX}probe`;
  localStorage.setItem(probe, "1");
  localStorage.removeItem(probe);
  const names = () => Object.keys(localStorage).filter((name) => name.startsWith(PREFIX));
  return {
    kind: "localStorage",
    put: async (item) => localStorage.setItem(PREFIX + item.id, JSON.stringify(item)),
    remove: async (id) => localStorage.removeItem(PREFIX + id),
    all: async () => names().map((name) => JSON.parse(localStorage.getItem(name))),
  };
}

async function openDatabase() {
  const opening = indexedDB.open(DATABASE, 1);
  opening.onupgradeneeded = () => opening.result.createObjectStore(TABLE, { keyPath: "id" });
  const database = await settled(opening);
  const table = (mode) => database.transaction(TABLE, mode);
  return {
    kind: "indexedDB",
    put: (item) => written(table("readwrite"), (store) => store.put(item)),
    remove: (id) => written(table("readwrite"), (store) => store.delete(id)),
    all: () => settled(table("readonly").objectStore(TABLE).getAll()),
  };
}

/** A request's result; a database that another tab blocks counts as broken after a while. */
function settled(request) {
  return new Promise((resolve, reject) => {
    setTimeout(() => reject(new Error("no answer from the database")), PATIENCE);
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

/** Done when the transaction is, not merely when the request is. */
function written(transaction, act) {
  return new Promise((resolve, reject) => {
    setTimeout(() => reject(new Error("no answer from the database")), PATIENCE);
    transaction.oncomplete = () => resolve();
    transaction.onabort = transaction.onerror = () => reject(transaction.error);
    act(transaction.objectStore(TABLE));
    // At once: left to itself it waits for one more word from this page, which may be closed by then.
    transaction.commit?.();
  });
}
