model Counter "A whole number and a truth value"
  input Integer n(start = 0);
  input Boolean on(start = false);
  input Real u(start = 0);
  output Integer twice;
  output Boolean off;
equation
  twice = 2*n;
  off = not on;
end Counter;
