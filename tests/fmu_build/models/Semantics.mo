package Semantics "Operators, arrays, functions and modifiers, each with a value to check"
  function f
    input Real t[:,:];
    input Integer n = 1;
    output Real y;
  protected
    Real c[size(t,1)];
    Real m[2,2];
  algorithm
    c := t[:,2];
    m := t[1:2,1:2];
    m[2,:] := {7, 8};
    y := c[end] + sum(m) + n;
    for i in 1:size(t,1) loop for j in 1:2 loop
      y := y + i*t[i,j]; end for;
    end for;
    y := y - 1;
  end f;
  function g "early return with constant condition"
    input Integer k;
    output Real y = 5;
  algorithm
    if k > 2 then
      y := 1;
      return;
    end if;
    y := 2;
  end g;
  function fact
    input Integer n;
    output Integer y;
  algorithm
    y := if n <= 1 then 1 else n*fact(n-1);
  end fact;
  constant Real kk[3] = {1,2,3};
  type E = enumeration(a, b, c);
  model Inner
    parameter Real q = 1;
    parameter Real r = 2*q;
    Real z = q + r;
  end Inner;
  model Mid
    extends Inner(q = 5);
    Inner sub[2](q = {q, 2*q}, each r = 9);
  end Mid;
  model T
    parameter Real 'odd name' = 3;
    parameter Real A[3,3] = [1,2,3;4,5,6;7,8,9];
    parameter Integer i2 = 2;
    parameter E e = E.b;
    Mid mid(sub(each r = 10));
    Mid mid2(r=1, q=2);
    Real y[37];
    Real x2[2] = {time, 2} "vec";
    Boolean bb = not true or true;
    Integer ii = div(7, 2) + mod(-7, 3) + integer(2.7);
  equation
    y[1] = -2^2;
    y[2] = 2^3;
    y[3] = 7/2*2;
    y[4] = 1 - 2 - 3;
    y[5] = if not false and false or true then 1 else 0;
    y[6] = if E.a < E.b then 1 else 0;
    y[7] = sum(A[2:3, 2]);
    y[8] = A[end, end] + A[i2, 1];
    y[9] = sum(1:2:7) + sum(5:-2:1);
    y[10] = max(A) + min({3, -1, 2});
    y[11] = f(A);
    y[12] = f(t=A, n=4);
    y[13] = g(3) + g(1);
    y[14] = fact(5);
    y[15] = 'odd name';
    y[16] = sum({if i > 2 then i else 0 for i in 1:4});
    y[17] = A[1,:]*A[:,1];
    y[18] = sum(A*A);
    y[19] = sum(transpose(A)*{1,0,0});
    y[20] = -x2[2]^2;
    y[21] = kk[2] + Semantics.kk[3];
    y[22] = 2 + size(A,2);
    y[23] = if e == E.b then 1 else 2;
    y[24] = 1e-3 + .5 + 2.;
    y[25] = sum(2 .^ {1,2}) + sum({1,2} ./ {2,4}) + sum({1,2} .* {3,4});
    y[26] = sum(cat(1, {1,2}, {3})) + sum([A, {1,2,3}]);
    y[27] = abs(-3) + sign(-2) + floor(-2.5) + ceil(2.1) + rem(-7, 3);
    y[28] = 3 - (-2) + (+1);
    y[29] = outerP[1,2];
    y[30] = 2*3 - 4/2^2;
    y[31] = sum(diagonal({1,2,3}));
    y[32] = sum(ones(2,2)) + sum(zeros(3)) + sum(fill(2,2));
    y[33] = sum(linspace(0,1,5));
    y[34] = if time < -1 then 1 elseif time < 5 then 2 else 3;
    y[35] = noEvent(if -time > 1 then 1 else 2);
    y[36] = sum(identity(3)) + 11;
    y[37] = product({2,3}) + sum(x2);
  protected
    Real outerP[2,2] = outerProduct({1,2},{3,4});
  end T;
end Semantics;
