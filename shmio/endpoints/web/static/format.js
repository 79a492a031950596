// Numbers as people read them.

/** @param {number} seconds @returns {string} */
export function duration(seconds) {
  const whole = Math.round(seconds);
  if (seconds < 1) return `${Math.round(1000 * seconds)} ms`;
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  if (whole < 86400) return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
  return `${Math.floor(whole / 86400)} d ${Math.floor((whole % 86400) / 3600)} h`;
}

/** @param {number | null} count @returns {string} */
export function bytes(count) {
  if (count === null) return "";
  return count < 1e6 ? `${(count / 1e3).toFixed(0)} kB` : `${(count / 1e6).toFixed(1)} MB`;
}

/** @param {number | null | undefined} value @param {number} digits @returns {string} */
export function fixed(value, digits) {
  return value === null || value === undefined ? "" : value.toFixed(digits);
}
