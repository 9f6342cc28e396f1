// Small choices of the user that outlive the tab. Storage may be forbidden or full; then they live as long as the page.

const fallback = new Map<string, string>();

export function recall(name: string): string | null {
  try {
    return localStorage.getItem(`carril.${name}`) ?? fallback.get(name) ?? null;
  } catch {
    return fallback.get(name) ?? null;
  }
}

export function remember(name: string, value: string): void {
  fallback.set(name, value);
  try {
    localStorage.setItem(`carril.${name}`, value);
  } catch {
    // kept in `fallback`
  }
}
