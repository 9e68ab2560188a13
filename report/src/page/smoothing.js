/* The moving mean of a curve. */

/** The shares of the axis over which the mean may be taken; 0 is none. */
const SMOOTHINGS = [0, 0.05, 0.1, 0.2, 0.4];

/**
 * The moving mean of a curve: at each point over the points that are at most half of `width` away on the x axis, and over
 * its neighbours in any case. Where a point stands for several records, `sums` and `counts` hold the sum and the number of
 * those since the point before.
 */
function movingMean({ x, y, sums, counts }, width) {
  const selected = Boolean(counts?.length);
  const [sum, count] = [[0], [0]];
  y.forEach((value, i) => {
    const known = isNumber(value);
    sum.push(sum[i] + (selected ? (sums[i] ?? 0) : known ? value : 0));
    count.push(count[i] + (selected ? counts[i] : Number(known)));
  });
  let [from, to] = [0, 0];
  return y.map((value, i) => {
    if (!isNumber(value)) return null;
    while (x[from] < x[i] - width / 2) from += 1;
    while (to + 1 < x.length && x[to + 1] <= x[i] + width / 2) to += 1;
    const first = Math.max(0, Math.min(from, i - 1));
    const end = Math.min(x.length, Math.max(to, i + 1) + 1);
    return (sum[end] - sum[first]) / (count[end] - count[first]);
  });
}
